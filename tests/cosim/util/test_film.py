"""Films: playable in browsers, equal bytes every time, and nothing left of a failed one."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from playwright import sync_api as playwright

from tests.support import requirements
from tests.support.cosim.full_disk import room_for
from tests.support.cosim.view_pages import ARGUMENTS
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util import pictures as films_module
from vcmvsp.cosim.util.pictures import write_film

pytestmark = [pytest.mark.processes, pytest.mark.browser]

COUNT, FPS = 25, 10


def pictures(count: int = COUNT) -> Iterator[Array]:
    """Incompressible noise, and a white bar that moves."""
    for number in range(count):
        picture = np.random.default_rng(number).integers(0, 60, (120, 160, 3)).astype(np.uint8)
        picture[:, 5 * number : 5 * number + 20] = 255
        yield picture


def test_a_film_has_all_pictures_in_a_format_that_browsers_play(tmp_path: Path) -> None:
    write_film(tmp_path / "film.mp4", pictures(), FPS)
    with av.open(str(tmp_path / "film.mp4")) as opened:
        (stream,) = opened.streams.video
        shown = [frame.to_ndarray(format="bgr24") for frame in opened.decode(stream)]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) in {("vp9", "yuv420p"), ("h264", "yuv420p")}
        assert stream.average_rate == FPS
    assert len(shown) == COUNT
    for number, picture in enumerate(shown):
        assert picture[:, 5 * number + 5 : 5 * number + 15].min() > 200


def test_the_same_pictures_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one.mp4", "two.mp4"):
        write_film(tmp_path / name, pictures(), FPS)
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()


@pytest.mark.parametrize("room", [0, 500, 30_000])
def test_on_a_full_disk_there_is_one_error_and_nothing_is_left(room: int, tmp_path: Path) -> None:
    with room_for(room), pytest.raises(OSError, match="File too large"):
        write_film(tmp_path / "film.mp4", pictures(), FPS)
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cannot_be_read_back_is_no_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = films_module._encode

    def lost(place: Path, *arguments: Any) -> int:
        return whole(place, *arguments) + 1

    def cut(place: Path, *arguments: Any) -> int:
        count = whole(place, *arguments)
        place.write_bytes(place.read_bytes()[:-400])
        return count

    for encode in (lost, cut):
        monkeypatch.setattr(films_module, "_encode", encode)
        with pytest.raises(OSError, match=r"pictures can be read back|[Ii]nvalid data"):
            write_film(tmp_path / "film.mp4", pictures(), FPS)
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_is_interrupted_leaves_nothing(tmp_path: Path) -> None:
    def some() -> Iterator[Array]:
        yield from pictures(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "film.mp4", some(), FPS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.needs("chromium")
def test_a_browser_plays_it(tmp_path: Path) -> None:
    write_film(tmp_path / "film.mp4", pictures(), FPS)
    (tmp_path / "page.html").write_text("<video src=film.mp4 muted></video>")
    with playwright.sync_playwright() as started:
        page = started.chromium.launch(executable_path=requirements.program("chromium"), args=ARGUMENTS).new_page()
        page.goto((tmp_path / "page.html").as_uri())
        film = "const film = document.querySelector('video'); film.onended = () => done(film.duration); film.play()"
        ended = f"() => new Promise(done => {{ {film} }})"
        assert page.evaluate(ended) == pytest.approx(COUNT / FPS, abs=0.2)
