"""What stands in a PyBullet world: the ground, the obstacle and the robot, all made at run time."""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from torchrl_sspl.envs.quadruped.arena import check_shape
from torchrl_sspl.errors import ConfigError, MissingDependencyError

# In m: tall enough to be hit by legs and body, low enough that the back of a robot is always seen from above.
OBSTACLE_HEIGHT = 0.25
OBSTACLE_COLOUR = (0.85, 0.15, 0.15, 1.0)
_TRUNK_COLOUR = (0.10, 0.25, 0.85, 1.0)
_LEG_COLOUR = (0.20, 0.20, 0.22, 1.0)
_HEAD_COLOUR = (1.0, 0.85, 0.0, 1.0)
_HEAD_PLATE = {"xyz": "0.2 0 0.06", "size": "0.14 0.24 0.02"}
GROUND_FRICTION, _TOE_FRICTION = 0.9, 1.0  # coefficients; those of two bodies that touch are multiplied


def import_pybullet() -> tuple[ModuleType, str]:
    """PyBullet and the directory of its data; MissingDependencyError without PyBullet or the A1 in its data."""
    try:
        with _quiet():
            import pybullet
        import pybullet_data
    except ImportError as error:
        raise MissingDependencyError(
            "Simulating the quadruped needs pybullet, which is not installed; run "
            "`pip install 'torchrl-sspl[quadruped]'`."
        ) from error
    data = pybullet_data.getDataPath()
    if not (Path(data) / "a1" / "a1.urdf").is_file():
        raise MissingDependencyError(
            f"The robot: expected a1/a1.urdf in pybullet's data directory {data}, found none; reinstall pybullet."
        )
    return pybullet, data


def connect(gui: bool = False) -> Any:
    """A world of its own: a PyBullet client without gravity and without bodies, ``gui``: in a window.

    Raises MissingDependencyError without PyBullet; ConfigError if a window is asked for and there is no display.
    """
    pybullet, _ = import_pybullet()
    from pybullet_utils import bullet_client

    if gui:
        _check_display()
    with _quiet():
        client = bullet_client.BulletClient(pybullet.GUI if gui else pybullet.DIRECT)
    if client._client < 0:
        raise ConfigError("gui: expected a connection to PyBullet, received none; use gui=False.")
    return client


def add_ground(client: Any) -> int:
    """An endless level ground; nothing of it is drawn, so that frames show robot and obstacle alone."""
    shape = client.createCollisionShape(client.GEOM_PLANE)
    ground = client.createMultiBody(0, shape)
    client.changeDynamics(ground, -1, lateralFriction=GROUND_FRICTION)
    client.changeVisualShape(ground, -1, rgbaColor=[0, 0, 0, 0])
    return ground


def add_obstacle(client: Any, shape: str, half_size: float, centre: Sequence[float]) -> int:
    """A box ("square") or cylinder ("disc") on the ground at (x, y), ``half_size`` its half edge or radius, all in m.

    Raises ConfigError for another shape.
    """
    check_shape(shape)
    if shape == "square":
        kind: int = client.GEOM_BOX
        size: dict[str, Any] = {"halfExtents": [half_size, half_size, OBSTACLE_HEIGHT / 2]}
        solid = client.createCollisionShape(kind, **size)
    else:
        kind, size = client.GEOM_CYLINDER, {"radius": half_size, "length": OBSTACLE_HEIGHT}
        solid = client.createCollisionShape(kind, radius=half_size, height=OBSTACLE_HEIGHT)
    drawn = client.createVisualShape(kind, rgbaColor=OBSTACLE_COLOUR, **size)
    return client.createMultiBody(0, solid, drawn, [*centre, OBSTACLE_HEIGHT / 2])


def add_robot(client: Any, *, meshes: bool = False) -> int:
    """The Unitree A1 of PyBullet's data, drawn by its collision shapes in plain colours, with a yellow plate as head.

    ``meshes``: draw its meshes instead, thirty times slower; masses and collision shapes are the same. Raises
    MissingDependencyError without PyBullet's data or a mesh.
    """
    _, data = import_pybullet()
    folder = Path(data) / "a1"
    path = str(folder / "a1.urdf")
    if meshes:
        for mesh in ElementTree.parse(path).iter("mesh"):
            if not (folder / mesh.attrib["filename"]).is_file():
                raise MissingDependencyError(
                    f"The robot: expected the mesh {mesh.attrib['filename']} in {folder}, found none; reinstall "
                    "pybullet or use meshes=False."
                )
    else:
        path = _plain_urdf(path)
    with _quiet():
        robot = client.loadURDF(path, [0, 0, 0.3], flags=client.URDF_USE_INERTIA_FROM_FILE)
    for link in range(-1, client.getNumJoints(robot)):
        client.changeDynamics(robot, link, linearDamping=0, angularDamping=0, jointDamping=0)
        if link >= 0 and client.getJointInfo(robot, link)[1].endswith(b"toe_fixed"):
            client.changeDynamics(robot, link, lateralFriction=_TOE_FRICTION)
    return robot


@functools.lru_cache(maxsize=2)
def _plain_urdf(source: str) -> str:
    """Write the robot with its collision shapes in place of its meshes; the path of the file."""
    tree = ElementTree.parse(source)
    for link in tree.getroot().findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        trunk = link.get("name") == "trunk"
        collision = link.find("collision")
        geometry = None if collision is None else collision.find("geometry")
        if collision is not None and geometry is not None and geometry.find("mesh") is None:
            parts = [copy.deepcopy(part) for part in (collision.find("origin"), geometry) if part is not None]
            _add_visual(link, parts, _TRUNK_COLOUR if trunk else _LEG_COLOUR)
        if trunk:
            plate = ElementTree.Element("geometry")
            ElementTree.SubElement(plate, "box", size=_HEAD_PLATE["size"])
            _add_visual(link, [ElementTree.Element("origin", xyz=_HEAD_PLATE["xyz"], rpy="0 0 0"), plate], _HEAD_COLOUR)
    handle, path = tempfile.mkstemp(prefix="a1_", suffix=".urdf", dir=_temporary().name)
    os.close(handle)
    tree.write(path)
    return path


def _add_visual(link: ElementTree.Element, parts: list[ElementTree.Element], colour: Sequence[float]) -> None:
    visual = ElementTree.SubElement(link, "visual")
    visual.extend(parts)
    # The colour is part of the name: parsers keep the first of several materials with one name.
    material = ElementTree.SubElement(visual, "material", name="rgba_" + "_".join(f"{c:g}" for c in colour))
    ElementTree.SubElement(material, "color", rgba=" ".join(str(c) for c in colour))


@functools.lru_cache(maxsize=1)
def _temporary() -> tempfile.TemporaryDirectory[str]:
    """A directory that is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="quadruped_")


def _check_display() -> None:
    """Raise unless a window can be opened: PyBullet would end the whole process."""
    if sys.platform != "linux":
        return
    name = os.environ.get("DISPLAY")
    if name:
        import ctypes
        import ctypes.util

        library = ctypes.util.find_library("X11") or "libX11.so.6"
        try:
            x11 = ctypes.CDLL(library)
            x11.XOpenDisplay.restype = ctypes.c_void_p
            display = x11.XOpenDisplay(name.encode())
            if display:
                x11.XCloseDisplay(ctypes.c_void_p(display))
                return
        except OSError:
            pass
    raise ConfigError(
        f"gui: expected a display, received DISPLAY={name!r} that cannot be opened; use gui=False, or start a virtual "
        "display."
    )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what a C library prints away from standard output and standard error."""
    null, saved = os.open(os.devnull, os.O_WRONLY), [(stream, os.dup(stream)) for stream in (1, 2)]
    for stream, _ in saved:
        os.dup2(null, stream)
    try:
        yield
    finally:
        for stream, copied in saved:
            os.dup2(copied, stream)
            os.close(copied)
        os.close(null)
