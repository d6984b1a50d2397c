"""Load an arm from an MJCF file: MuJoCo's model and the chain that leads to the camera."""

from __future__ import annotations

import html
import math
import os
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env._runtime.input_files import MAX_MESH_BYTES, MAX_TEXT_BYTES, check_file, read_bytes
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose
from ms_slam_env.robot.arm.chain import Chain, separate_pairs

ARM_MODELS = {"mico": Path(__file__).with_name("mico.xml")}
"""Arms that come with the package."""

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_BALL = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_NAMED = re.compile(r"""(?=\b(file\w*|(?:mesh|texture|asset)dir)\s*=\s*(?:"([^"]*)"|'([^']*)'))""")
_ROBOT = re.compile(r"<robot[\s>]")  # root of a URDF


@dataclass(frozen=True, eq=False)
class ArmModel:
    """MuJoCo's model and the parts that the planner needs; shared, never changed.

    Attributes:
        path: the MJCF file.
        mj: the compiled model, its base at the origin.
        chain: the ``n`` hinges from base to camera.
        qpos: (n,) places of the hinges in MuJoCo's ``qpos``.
        dof: (n,) places in ``qvel``.
        actuators: (n,) the position actuator of each hinge.
        camera_site: id of the camera's site.
        home: (n,) joint angles to start a search from: key frame ``home``, or the initial state.
    """

    path: Path
    mj: mujoco.MjModel
    chain: Chain
    qpos: Int32
    dof: Int32
    actuators: Int32
    camera_site: int
    home: Float64


@lru_cache(maxsize=8)
def load_arm(model: str, camera_site: str = "camera", joint_speed_rad_s: float = 1.0) -> ArmModel:
    """Read arm ``model``: a name of ``ARM_MODELS`` or the path of an MJCF file.

    The file needs a site ``camera_site`` with the axes of a camera (x right, y down, z forward)
    that hinges lead to, each with a position actuator and no other joint between. A ``<custom>``
    numeric ``joint_speed`` gives the greatest speeds of the joints in radians per second;
    ``joint_speed_rad_s`` applies where it is missing. Joints outside the chain keep their initial
    position.

    Raises:
        InputError: no such file, not an MJCF, no such site, or joints that are not a serial arm.
    """
    path = ARM_MODELS.get(model, Path(model))
    mj = _compile(model, path)
    site = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_SITE, camera_site)
    if site < 0:
        raise _no_site(mj, camera_site, path)
    joints = _joints_to(mj, int(mj.site_bodyid[site]), path)
    qpos = mj.jnt_qposadr[joints].astype(np.int32)
    key = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_KEY, "home")
    home = (mj.key_qpos[key] if key >= 0 else mj.qpos0)[qpos].copy()
    speed = _joint_speed(mj, joints, joint_speed_rad_s, path)
    chain = _chain(mj, joints, site, speed, home)
    return ArmModel(
        path=path,
        mj=mj,
        chain=chain,
        qpos=qpos,
        dof=mj.jnt_dofadr[joints].astype(np.int32),
        actuators=_actuators(mj, joints, path),
        camera_site=site,
        home=home,
    )


def _compile(model: str, path: Path) -> mujoco.MjModel:
    if not path.is_file():
        raise InputError(
            f"arm.model {model!r}: no such file; valid choices: {', '.join(ARM_MODELS)}, "
            "or the path of an MJCF file"
        )
    text = _checked_text(path)
    if path.suffix == ".urdf" or _ROBOT.search(text):
        raise InputError(
            f"arm {path} is a URDF; an MJCF is needed: load the file in MuJoCo, save it with "
            "mujoco.mj_saveLastXML, and add position actuators and a camera site"
        )
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"arm {path}: MuJoCo cannot read it: {reason}") from None


def _checked_text(path: Path) -> str:
    """Read a model's text, and check the files that it and its includes may name.

    MuJoCo opens these itself, and would wait for ever on a pipe. Names in comments and in folders
    of other assets are also checked.

    Raises:
        InputError: one of the files is not a regular file, or is too large.
    """
    texts: list[str] = []
    names: set[str] = set()
    folders, seen, waiting = {path.parent}, {path}, [path]
    while waiting:
        file = waiting.pop()
        texts.append(read_bytes(file, "arm model", MAX_TEXT_BYTES).decode(errors="replace"))
        folders.add(file.parent)
        for found in _NAMED.finditer(texts[-1]):
            value = html.unescape(found[2] or found[3] or "")
            if found[1].endswith("dir"):
                folders |= {base / value for base in (path.parent, file.parent)}
            else:
                names |= {value, Path(value).name}  # the latter with strippath
        for place in sorted({base / name for base in folders for name in names} - seen):
            if os.path.exists(place) and not os.path.isdir(place):
                seen.add(place)
                check_file(place, f"file of arm {path},", MAX_MESH_BYTES)
                with place.open("rb") as opened:
                    is_xml = opened.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
                waiting += [place] if is_xml else []
    return texts[0]


def _no_site(mj: mujoco.MjModel, wanted: str, path: Path) -> InputError:
    """The error for an arm without a camera site, with the remedy."""
    sites = [mj.site(i).name for i in range(mj.nsite)]
    choose = "set arm.camera_site to one of them, or " if sites else ""
    cameras = "its <camera> elements do not count: " if mj.ncam else ""
    return InputError(
        f"arm {path}: no site named {wanted!r}; its sites: {', '.join(sites) or 'none'}; "
        f'{choose}{cameras}add <site name="{wanted}" pos="..." quat="..."/> with the axes of a '
        "camera (x right, y down, z forward) to the body that holds it"
    )


def _joints_to(mj: mujoco.MjModel, body: int, path: Path) -> Int32:
    """Ids of the hinges from the world to ``body``, in that order."""
    joints: list[int] = []
    while body > 0:
        first, count = int(mj.body_jntadr[body]), int(mj.body_jntnum[body])
        if count > 1:
            raise InputError(f"arm {path}: body {mj.body(body).name!r} has {count} joints, not one")
        if count == 1:
            if mj.jnt_type[first] != mujoco.mjtJoint.mjJNT_HINGE:
                raise InputError(
                    f"arm {path}: joint {mj.joint(first).name!r} on the way to the camera "
                    "is not a hinge"
                )
            joints.append(first)
        body = int(mj.body_parentid[body])
    if not joints:
        raise InputError(f"arm {path}: no joint moves the camera's site")
    return np.array(joints[::-1], dtype=np.int32)


def _actuators(mj: mujoco.MjModel, joints: Int32, path: Path) -> Int32:
    found = []
    for joint in joints:
        drives = (mj.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (
            mj.actuator_trnid[:, 0] == joint
        )
        holds = mj.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
        place = np.flatnonzero(drives & holds & (mj.actuator_biasprm[:, 1] < 0))
        if len(place) != 1:
            raise InputError(
                f"arm {path}: joint {mj.joint(joint).name!r} needs one position actuator, "
                f"it has {len(place)}"
            )
        found.append(int(place[0]))
    return np.array(found, dtype=np.int32)


def _joint_speed(mj: mujoco.MjModel, joints: Int32, fallback: float, path: Path) -> Float64:
    numeric = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, "joint_speed")
    if numeric < 0:
        return np.full(len(joints), fallback)
    start, size = int(mj.numeric_adr[numeric]), int(mj.numeric_size[numeric])
    speed = mj.numeric_data[start : start + size].copy()
    if size != len(joints) or not (speed > 0).all():
        raise InputError(
            f"arm {path}: numeric joint_speed must be {len(joints)} numbers above 0, has {speed}"
        )
    return speed


def _chain(mj: mujoco.MjModel, joints: Int32, site: int, speed: Float64, home: Float64) -> Chain:
    """Read the chain off the model's state at joint angles 0."""
    data = mujoco.MjData(mj)
    data.qpos[:] = mj.qpos0
    data.qpos[mj.jnt_qposadr[joints]] = 0
    mujoco.mj_kinematics(mj, data)
    bodies = mj.jnt_bodyid[joints]
    rotations = data.xmat[bodies].reshape(-1, 3, 3)
    links = [np.eye(4)]
    links += [
        make_pose(R, anchor) for R, anchor in zip(rotations, data.xanchor[joints], strict=True)
    ]
    site_pose = make_pose(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])
    limited = mj.jnt_limited[joints].astype(bool)
    capsules = link_capsules(mj, data, bodies, np.stack(links))
    chain = Chain(
        T_parent_joint=np.linalg.inv(links[:-1]) @ links[1:],
        axes=mj.jnt_axis[joints].copy(),
        T_last_camera=np.linalg.inv(links[-1]) @ site_pose,
        lower=np.where(limited, mj.jnt_range[joints, 0], -np.inf),
        upper=np.where(limited, mj.jnt_range[joints, 1], np.inf),
        speed=speed,
        capsule_link=capsules.link,
        capsule_ends=capsules.ends,
        capsule_radius=capsules.radius,
        self_pairs=np.zeros((0, 2), dtype=np.int32),
    )
    return separate_pairs(chain, home)


@dataclass(frozen=True)
class LinkCapsules:
    """Capsules (m,) with the link of each, ends (m, 2, 3) in the link's frame, and radius (m,)."""

    link: Int32
    ends: Float64
    radius: Float64


def link_capsules(
    mj: mujoco.MjModel, data: mujoco.MjData, bodies: Int32, T_base_link: Float64
) -> LinkCapsules:
    """Capsules around the colliding geoms of an arm at the state in ``data``.

    Args:
        mj: the model.
        data: after ``mj_kinematics``, joint angles as in ``T_base_link``.
        bodies: (n,) the bodies that the joints move.
        T_base_link: (n + 1, 4, 4) link frames, the base first.
    """
    link_of_body = _links(mj, bodies)
    link, ends, radius = [], [], []
    for geom in range(mj.ngeom):
        collides = mj.geom_contype[geom] or mj.geom_conaffinity[geom]
        if not collides or int(mj.geom_type[geom]) == _PLANE:
            continue
        half, r, axis, centre = _capsule(mj, geom)
        R, position = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        middle, along = position + R @ centre, half * R[:, axis]
        index = link_of_body[mj.geom_bodyid[geom]]
        inverse = np.linalg.inv(T_base_link[index])
        both = np.stack([middle - along, middle + along])
        link.append(index)
        ends.append(both @ inverse[:3, :3].T + inverse[:3, 3])
        radius.append(r)
    return LinkCapsules(
        np.array(link, dtype=np.int32), np.array(ends).reshape(-1, 2, 3), np.array(radius)
    )


def _links(mj: mujoco.MjModel, bodies: Int32) -> dict[int, int]:
    """The link of each body: that of the last chain joint above it, 0 if there is none."""
    link_of_body = {0: 0}
    moved = {int(body): index + 1 for index, body in enumerate(bodies)}
    for body in range(1, mj.nbody):  # parents come first
        link_of_body[body] = moved.get(body, link_of_body[int(mj.body_parentid[body])])
    return link_of_body


def _capsule(mj: mujoco.MjModel, geom: int) -> tuple[float, float, int, Float64]:
    """Half length, radius, axis and centre (3,), in the geom's frame, of a capsule around it."""
    kind, size = int(mj.geom_type[geom]), mj.geom_size[geom]
    if kind == _BALL:
        return 0.0, float(size[0]), 2, np.zeros(3)
    if kind in _ROUND:
        return float(size[1]), float(size[0]), 2, np.zeros(3)
    # Boxes, ellipsoids and meshes by their bounding box, along its longest side. Ending the axis
    # before the corners costs width and saves more length.
    centre, half_sides = mj.geom_aabb[geom, :3].copy(), mj.geom_aabb[geom, 3:]
    axis = int(np.argmax(half_sides))
    across = float(np.linalg.norm(np.delete(half_sides, axis)))
    half = max(0.0, float(half_sides[axis]) - 0.5 * across)
    return half, math.hypot(across, half_sides[axis] - half), axis, centre
