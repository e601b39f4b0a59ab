"""A world in a TOML file of its own, with the keys of a scenario's ``[world]``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import FileName, NonNegative
from vcmvsp.cosim.util.documents import read_toml
from vcmvsp.physics.importers.file_access import require_file, text_of
from vcmvsp.physics.world.world import Light, Wind, World
from vcmvsp.physics.worlds.boxes import Empty


@dataclass(frozen=True, kw_only=True)
class File:
    """A world from a TOML file (kind ``file``): ``[[boxes]]``, ``[[cylinders]]``, ``[ground]`` ... as in kind ``boxes``.

    Pictures are found beside the file.
    """

    path: FileName  # of the TOML file
    floor_friction: NonNegative | None = None  # multiplies the friction of what rolls or slides; None: the file's
    wind: Wind | None = None  # air that moves; None: the file's
    light: Light | None = None  # where the sun is; None: the file's

    def __post_init__(self) -> None:
        require_file(self.path)

    def files(self) -> tuple[Path, ...]:
        """The pictures that it names."""
        listed, _ = self._read()
        pictures = [listed.ground.picture, *[mark.picture for mark in listed.ground.marks]]
        pictures += [target.picture for target in listed.targets]
        return tuple(Path(each) for each in pictures if each)

    def _read(self) -> tuple[Empty, Source]:
        path = Path(self.path)
        text = text_of(path)
        try:
            content = read_toml(text)
        except ValueError as error:
            raise ScenarioError(f"is not TOML: {error}", source=str(path)) from error
        source = Source(str(path), path.parent, text)
        listed = binding.call(Empty, content, origin=source)
        return beside(path.parent, listed), source

    def build(self) -> World:
        """The world itself.

        Raises:
            ScenarioError: with the file, the line and the key that is wrong.
        """
        listed, source = self._read()
        try:
            world = listed.build()
        except ScenarioError as error:
            raise ScenarioError(error.problem, key=error.key, source=source.of(error.key)) from error
        instead: dict[str, Any] = {"floor_friction": self.floor_friction, "wind": self.wind, "light": self.light}
        overrides = {key: value for key, value in instead.items() if value is not None}
        return replace(world, name=Path(self.path).stem, **overrides)


def beside(folder: Path, listed: Empty) -> Empty:
    """The world with its pictures found in a folder."""

    def found(name: str) -> str:
        """Where a picture is; a run keeps it under its last name, beside the file."""
        places = [registry.located(each, folder) for each in (name, Path(name).name)]
        return str(next((path for path in places if path.is_file()), places[0])) if name else ""

    marks = tuple(msgspec.structs.replace(each, picture=found(each.picture)) for each in listed.ground.marks)
    targets = tuple(msgspec.structs.replace(each, picture=found(each.picture)) for each in listed.targets)
    ground = msgspec.structs.replace(listed.ground, picture=found(listed.ground.picture), marks=marks)
    return replace(listed, ground=ground, targets=targets)
