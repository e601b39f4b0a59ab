"""Towns that have the seed of their run: each seed another one, and whoever looks at a run the same."""

from pathlib import Path

import vcmvsp
from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.physics.world.floor import GroundTarget
from vcmvsp.physics.worlds.recreation import RecreationCentre
from vcmvsp.physics.worlds.urban import Urban


def test_a_town_without_a_seed_of_its_own_has_that_of_the_run() -> None:
    source = Source("test", Path())
    towns = {seed: worlds.build({"kind": "urban", "targets": [{}]}, source, seed=seed) for seed in (1, 2)}
    for seed, (world, resolved) in towns.items():
        assert world == Urban(seed=seed, targets=(GroundTarget(),)).build()
        assert "seed" not in resolved  # the resolved scenario has that of the run
        assert worlds.build({"kind": "urban", "seed": 2}, source, seed=seed)[1]["seed"] == 2
    assert towns[1][0].solids != towns[2][0].solids
    assert towns[1][0].targets != towns[2][0].targets
    assert worlds.build({"kind": "recreation-centre"}, source, seed=5)[0] == RecreationCentre().build()


def test_a_run_its_drawing_and_its_radio_are_in_the_same_town(tmp_path: Path) -> None:
    """And what the run keeps is the same town again, with its pictures."""
    listed = [{"name": name, "picture": f"targets/{name}.png"} for name in ("alpha", "bravo")]
    scenario = {
        "name": "town",
        "duration_s": 0.1,
        "seed": 7,
        "physics": {"kind": "kinematic"},
        "world": {"kind": "urban", "targets": listed},
        "vehicle": [{"name": "uav", "kind": "point", "position": [0, 0, 40]}],
    }
    world = Urban(seed=7, targets=tuple(GroundTarget(name=each["name"]) for each in listed)).build()
    with assemble(*scenarios.load(scenario)) as assembled:
        assert assembled.world.solids == world.solids
        assert [each.place(0.0) for each in assembled.world.targets] == [each.place(0.0) for each in world.targets]
    vcmvsp.run(scenario, out=tmp_path / "run")
    assert {"alpha.png", "bravo.png"} <= {path.name for path in (tmp_path / "run").iterdir()}
    kept, _ = worlds.world_of(str(tmp_path / "run" / "scenario.toml"), {})
    assert kept.solids == world.solids
    assert [each.picture for each in kept.targets] == [str(tmp_path / "run" / f"{each['name']}.png") for each in listed]
    assert len({worlds.world_of(str(tmp_path / "run" / "scenario.toml"), {"seed": k})[0].solids for k in range(4)}) == 4
