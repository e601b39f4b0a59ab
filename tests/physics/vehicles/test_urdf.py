"""Vehicles from URDF: driving by their parameters, and messages for missing elements."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS, engine
from tests.support.physics.runs import run, values
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import ORIGIN
from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.vehicles.urdf import UrdfDrive, UrdfQuadrotor
from vcmvsp.physics.vehicles.urdf_shapes import GREY
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

# A user's robot.
ROBOT = """\
<robot name="cart">
  <link name="base">
    <inertial><origin xyz="-0.05 0 0.12"/><mass value="6"/><inertia ixx="0.06" iyy="0.08" izz="0.1"/></inertial>
    <collision><origin xyz="-0.05 0 0.15"/><geometry><box size="0.4 0.3 0.16"/></geometry></collision>
    <collision><origin xyz="-0.2 0 0.03"/><geometry><sphere radius="0.03"/></geometry></collision>
  </link>
  <link name="left"><inertial><mass value="0.5"/><inertia ixx="1e-3" iyy="2e-3" izz="1e-3"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="right"><inertial><mass value="0.5"/><inertia ixx="1e-3" iyy="2e-3" izz="1e-3"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <joint name="left_wheel" type="continuous"><parent link="base"/><child link="left"/>
    <origin xyz="0.05 0.2 0.1"/><axis xyz="0 1 0"/></joint>
  <joint name="right_wheel" type="continuous"><parent link="base"/><child link="right"/>
    <origin xyz="0.05 -0.2 0.1"/><axis xyz="0 -1 0"/></joint>
</robot>
"""

LINK = '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>'
JOINT = '<joint name="{1}" type="fixed"><parent link="{0}"/><child link="{1}"/></joint>'
STRAYS = LINK.format("x") + LINK.format("y") + JOINT.format("x", "y") + JOINT.format("y", "x")
SECOND = JOINT.format("right", "left")

FRAME = """\
<robot name="frame">
  <link name="body"><inertial><mass value="0.4"/><inertia ixx="1e-3" iyy="1e-3" izz="2e-3"/></inertial></link>
  <link name="front"><inertial><mass value="0.2"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>
  <link name="back"><inertial><origin xyz="0 0.2 0"/><mass value="0.2"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>
  <joint name="a" type="fixed"><parent link="body"/><child link="front"/><origin xyz="0.2 0 0"/></joint>
  <joint name="b" type="fixed"><parent link="body"/><child link="back"/><origin rpy="0 0 1.57079632679"/></joint>
</robot>
"""


def drive_of(folder: Path, text: str = ROBOT, **keys: Any) -> UrdfDrive:
    (folder / "cart.urdf").write_text(text)
    return UrdfDrive(file=str(folder / "cart.urdf"), left_wheel="left_wheel", right_wheel="right_wheel", **keys)


@pytest.fixture
def cart(tmp_path: Path) -> UrdfDrive:
    return drive_of(tmp_path, max_speed=1.2, accel=0.8)


def test_the_file_places_the_wheels(cart: UrdfDrive) -> None:
    assert cart.wheel_radius_m == pytest.approx(0.1)
    assert cart.track_m == pytest.approx(0.4)
    assert cart.plan.axle == pytest.approx((0.05, 0.0, 0.0))
    assert cart.plan.signs == (1.0, -1.0)


def test_it_starts_in_place_with_the_inertia_of_the_file(cart: UrdfDrive) -> None:
    moved = engine((cart, (1.0, 2.0, 0.0)), headings=[0.7])
    assert moved.read().position[0] == pytest.approx((1.0, 2.0, 0.0), abs=1e-9)
    assert moved.read().attitude[0] == pytest.approx((math.cos(0.35), 0.0, 0.0, math.sin(0.35)))
    body = moved._robots.bodies[0]
    base, left = (p.getDynamicsInfo(body, link, moved._client) for link in (-1, 0))
    assert (base[0], left[0]) == (6.0, 0.5)
    assert base[2] == pytest.approx((0.06, 0.08, 0.1))
    moved.advance(2 * SECOND_NS)
    assert moved.read().position[0] == pytest.approx((1.0, 2.0, 0.0), abs=3e-3)
    assert sum(contact[9] for contact in p.getContactPoints(bodyA=body, physicsClientId=moved._client)) == pytest.approx(
        7.0 * 9.81, rel=0.01
    )


def test_it_drives_as_commanded(cart: UrdfDrive) -> None:
    moved = engine((cart, ORIGIN))
    moved.command(0, (0.5, 0.0, 0.0), 0.4)
    moved.advance(4 * SECOND_NS)
    steady = moved.read()
    assert np.hypot(*steady.velocity[0, :2]) == pytest.approx(0.5, rel=0.01)
    assert steady.angular_velocity[0, 2] == pytest.approx(0.4, rel=0.01)
    assert steady.odometry[0, 3:] == pytest.approx((0.5, 0.4), rel=0.01)
    assert steady.odometry[0, :2] == pytest.approx(steady.position[0, :2], abs=0.02)
    assert (np.diff(steady.wheels[0]) > 0.0).all()  # the right wheel has turned further, both forward
    assert (steady.wheels > 0.0).all()


def test_firmware_limits_are_kept(cart: UrdfDrive) -> None:
    moved = engine((cart, ORIGIN))
    moved.command(0, (9.0, 0.0, 0.0), 0.0)
    moved.advance(SECOND_NS)
    assert moved.read().velocity[0, 0] == pytest.approx(0.8, rel=0.05)  # limited by accel
    moved.advance(4 * SECOND_NS)
    assert moved.read().velocity[0, 0] == pytest.approx(1.2, rel=0.01)


@KINDS
def test_it_is_a_vehicle_of_both_kinds_of_physics(kind: Any, cart: UrdfDrive) -> None:
    physics = kind(world=World(), vehicles=[VehicleSpec(name="cart", model=cart)])
    events = run(physics, [(0.0, "cart", 0.5, 0.0)], 3.0)
    assert 1.2 < values(events, "cart/odometry")[-1].pose[0] < 1.51


def test_a_quadrotor_takes_mass_and_inertia_of_all_its_links(tmp_path: Path) -> None:
    file = tmp_path / "frame.urdf"
    file.write_text(FRAME)
    model = UrdfQuadrotor(file=str(file), max_rotor_speed=900.0)
    assert model.mass_kg == pytest.approx(0.8)
    # Two links of 0.2 kg at (+-0.2, 0): front by its joint, back by its inertial origin, turned by 90 degrees.
    assert model.inertia == pytest.approx((1.2e-3, 1.2e-3 + 0.016, 2.2e-3 + 0.016))
    moved = engine((model, ORIGIN))
    assert isinstance(moved.read().position, np.ndarray)


@pytest.mark.parametrize(
    ("old", "new", "words", "key"),
    [
        ('<inertia ixx="1e-3" iyy="2e-3" izz="1e-3"/>', "", "link 'left' .* no <inertia>", "file"),
        ('<mass value="0.5"/>', "", "link 'left' .* no <mass>", "file"),
        ('<mass value="0.5"/>', '<mass value="0"/>', "mass and inertia of the link 'left'", "file"),
        ('izz="0.1"', "", "link 'base' needs finite ixx", "file"),
        ('izz="0.1"', 'izz="much"', "invalid number", "file"),
        ('izz="0.1"', 'izz="0.1" ixy="0.01"', "root link 'base'", "file"),
        ('name="left_wheel"', 'name="wheel"', "no joint 'left_wheel'; joints: wheel, right_wheel", "left_wheel"),
        ('type="continuous"', 'type="fixed"', "'left_wheel' .* is fixed", "left_wheel"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 1"/>', "axis of 'left_wheel'", "left_wheel"),
        ("0.05 0.2 0.1", "0.05 -0.3 0.1", "not to the left", "left_wheel"),
        ('<child link="left"/>', '<child link="lost"/>', "the unknown link 'lost'", "file"),
        ("</robot>", "", "is not XML", "file"),
        ("robot", "model", "is not a URDF", "file"),
        ('<sphere radius="0.1"/>', '<box size="1 1 1"/>', "needs a sphere or cylinder", "left_wheel"),
        ('<sphere radius="0.1"/>', "<sphere/>", "sphere of the link 'left' .* needs a positive radius", "left_wheel"),
        ('radius="0.1"', 'radius="big"', "sphere of the link 'left' .* radius, not 'big'", "left_wheel"),
        ('radius="0.1"', 'radius="0.08"', r"same radius, not 0\.08 m and 0\.1 m", "right_wheel"),
        ('0.05 0.2 0.1"', '0.05 0.2 0.1" rpy="0 0"', "invalid number: '0 0' must be three", "file"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 one 0"/>', "invalid number", "file"),
        ("</robot>", STRAYS + "</robot>", "joints of cart.urdf form a loop: 'x'", "file"),
        ("</robot>", SECOND + "</robot>", "'left' of cart.urdf is the child of two joints", "file"),
    ],
)
def test_errors_of_a_file_are_named(old: str, new: str, words: str, key: str, tmp_path: Path) -> None:
    assert old in ROBOT
    with pytest.raises(ScenarioError, match=words) as raised:
        drive_of(tmp_path, ROBOT.replace(old, new, 2 if old == "robot" else 1))
    assert raised.value.key == key


@pytest.mark.parametrize("limits", ['lower="-1.5" ', 'upper="1.5" ', ""])
def test_a_wheel_may_be_revolute_without_limits(limits: str, tmp_path: Path) -> None:
    limit = f'<limit {limits}effort="10" velocity="10"/></joint>'
    text = ROBOT.replace("continuous", "revolute").replace("</joint>", limit)
    if limits:
        with pytest.raises(ScenarioError, match=r"'left_wheel' .* has limits.*: make it continuous") as raised:
            drive_of(tmp_path, text)
        assert raised.value.key == "left_wheel"
        return
    moved = engine((drive_of(tmp_path, text), ORIGIN))
    moved.command(0, (0.5, 0.0, 0.0), 0.0)
    moved.advance(6 * SECOND_NS)
    assert moved.read().wheels[0] == pytest.approx(2.75 / 0.1, rel=0.02)  # continuous rotation


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"none\.urdf cannot be read") as raised:
        UrdfQuadrotor(file=str(tmp_path / "none.urdf"))
    assert raised.value.key == "file"


def test_contacts_of_all_links_except_wheels_on_the_floor_are_named(cart: UrdfDrive) -> None:
    moved = engine((cart, ORIGIN), world=World(solids=(Box(center=(1.0, 0.0, 0.5), size=(0.2, 2.0, 1.0)),)))
    moved.advance(SECOND_NS)
    assert moved.touching(passing=True) == []
    moved.command(0, (0.4, 0.0, 0.0), 0.0)
    moved.advance(5 * SECOND_NS)
    assert {(touch.row, touch.other) for touch in moved.touching(passing=True)} == {(0, None)}
    assert moved.read().position[0, 0] - 0.05 - 0.05 + 0.2 == pytest.approx(0.9, abs=0.02)  # the base's box at the wall


# --- shapes for pictures ---

PAINTED = ROBOT.replace(
    "</inertial>\n    <collision>",
    '</inertial>\n    <visual><origin xyz="0 0 0.5"/><geometry><cylinder radius="0.1" length="0.4"/></geometry>'
    '<material name="blue"/></visual>\n    <visual><geometry><mesh filename="tip.obj" scale="2 2 2"/></geometry></visual>\n'
    "    <collision>",
    1,
).replace('<robot name="cart">', '<robot name="cart"><material name="blue"><color rgba="0 0 1 1"/></material>')


def test_the_collision_shapes_are_drawn_where_a_file_has_no_others(tmp_path: Path) -> None:
    (part,) = drive_of(tmp_path).drawn
    low, high = part.triangles.min(axis=(0, 1)), part.triangles.max(axis=(0, 1))
    # The frame's origin is below the axle, 0.05 m ahead of the root; wheels of 0.1 m, 0.2 m to each side.
    assert low == pytest.approx((-0.05 - 0.2 - 0.05, -0.3, 0.0), abs=2e-3)
    assert high == pytest.approx((0.1, 0.3, 0.23), abs=2e-3)


def test_visual_shapes_have_their_colours_and_meshes_their_scale(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / "tip.obj").write_text("v 0 0 1\nv 1 0 1\nv 0 1 1\nf 1 2 3\n")
    parts = {part.color: part.triangles for part in drive_of(tmp_path, PAINTED).drawn}
    assert parts.keys() == {(0, 0, 255), GREY}
    assert parts[0, 0, 255][..., 2].min() == pytest.approx(0.3)
    assert parts[0, 0, 255][..., 2].max() == pytest.approx(0.7)
    assert parts[GREY].tolist() == pytest.approx(np.array([[(-0.05, 0, 2), (1.95, 0, 2), (-0.05, 2, 2)]]))


def test_a_quadrotor_is_drawn_about_its_centre_of_mass(tmp_path: Path) -> None:
    box = '<visual><geometry><box size="0.2 0.2 0.2"/></geometry></visual></link>'
    heavy_ahead = FRAME.replace('xyz="0.2 0 0"', 'xyz="0.6 0 0"')  # 0.4, 0.2 and 0.2 kg at x = 0, 0.6 and -0.2 m
    (tmp_path / "frame.urdf").write_text(heavy_ahead.replace("</inertial></link>", f"</inertial>{box}", 1))
    (part,) = UrdfQuadrotor(file=str(tmp_path / "frame.urdf")).drawn
    middle = 0.5 * (part.triangles.min(axis=(0, 1)) + part.triangles.max(axis=(0, 1)))
    assert middle == pytest.approx((-0.1, 0.0, 0.0), abs=1e-9)


def test_undrawable_shapes_are_omitted(tmp_path: Path) -> None:
    places = {"0 0 0": '<box size="a b c"/>', "1 0 0": "<capsule/>", "two": '<sphere radius="1"/>'}
    shapes = [f'<visual><origin xyz="{xyz}"/><geometry>{kind}</geometry></visual>' for xyz, kind in places.items()]
    bad = "".join(shapes) + "</link>"
    assert drive_of(tmp_path, ROBOT.replace("</collision></link>", f"</collision>{bad}")).drawn == ()
