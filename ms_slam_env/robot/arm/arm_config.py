"""Configuration of an arm: model, base, speed, controller and imperfections."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ms_slam_env.config import Checked, Named, bounded
from ms_slam_env.errors import InputError

_MOST_RAD = math.radians(20)


@dataclass(frozen=True)
class ArmNoise(Checked, Named):
    """Imperfections of an arm beyond the sag and lag that follow from its physics.

    Drawn once per episode: zero offsets of the joint sensors, hand-eye calibration. Drawn
    continually: reading noise, vibration. ``none`` names the perfect arm, all zero; ``default``
    names these values.

    The sizes are assumed, not measured on a Mico: Kinova publishes none of them. They are chosen so
    that kinematics is off by millimetres and tenths of a degree, which is why the arm needs SLAM,
    and vibration stays well below a millimetre.

    Attributes:
        joint_offset_rad: standard deviation of a joint's zero offset, the bias of kinematics.
        encoder_rad: standard deviation of one joint reading.
        hand_eye_m: standard deviation, per axis, of the camera's assumed position on the hand.
        hand_eye_rad: the same for its orientation.
        backlash_rad: play of each gear, from end to end.
        vibration_nm: standard deviation of the torque noise of a joint moving at full speed, for
            the joint with the greatest torque; in proportion to torque for the others.
    """

    joint_offset_rad: float = bounded(math.radians(0.2), 0, _MOST_RAD)
    encoder_rad: float = bounded(math.radians(0.02), 0, _MOST_RAD)
    hand_eye_m: float = bounded(0.002, 0, 0.1)
    hand_eye_rad: float = bounded(math.radians(0.3), 0, _MOST_RAD)
    backlash_rad: float = bounded(math.radians(0.1), 0, _MOST_RAD)
    vibration_nm: float = bounded(1.0, 0, 100)

    @classmethod
    def named(cls) -> dict[str, ArmNoise]:
        """``none`` and ``default``."""
        return {"none": cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "default": cls()}


@dataclass(frozen=True)
class ArmConfig(Checked):
    """An arm that holds the camera.

    Attributes:
        model: ``mico``, or the path of an MJCF file whose hinges lead to a site with the axes of a
            camera (x right, y down, z forward).
        camera_site: name of that site.
        base: x, y, z (metres) and yaw (radians) of the arm's base in the world; None chooses a base
            from which the arm can hold the camera at the start pose.
        frames_per_action: frames that reach SLAM during one motion, the last at its end; None for
            as many as arrive at ``camera_hz`` while the arm moves at its real speed.
        camera_hz: frames per second.
        speed_m_s: speed of the camera; Kinova states 0.2 m/s for the Mico.
        speed_rad_s: rate of turn of the camera.
        joint_speed_rad_s: limit for every joint of a model that does not state its own.
        clearance_m: distance that the links keep from furniture and from each other.
        noise: imperfections: ``none``, ``default``, or the fields of :class:`ArmNoise` that differ
            from the default.
    """

    model: str = "mico"
    camera_site: str = "camera"
    base: tuple[float, float, float, float] | None = None
    frames_per_action: int | None = bounded(None, 1, 1000)
    camera_hz: float = bounded(10.0, 0.1, 30)
    speed_m_s: float = bounded(0.2, 0.001, 5)
    speed_rad_s: float = bounded(math.radians(36), 0.001, 20)
    joint_speed_rad_s: float = bounded(1.0, 0.001, 20)
    clearance_m: float = bounded(0.02, 0, 0.5)
    noise: ArmNoise = field(default_factory=ArmNoise)

    def __post_init__(self) -> None:
        """Refuse values out of range, invalid noise, and an invalid base."""
        super().__post_init__()
        if not isinstance(self.noise, ArmNoise):
            raise InputError(f"ArmConfig.noise = {self.noise!r} must be an ArmNoise")
        if self.base is not None:
            numbers = isinstance(self.base, (tuple, list)) and len(self.base) == 4
            if not numbers or not all(
                isinstance(v, (int, float)) and math.isfinite(v) for v in self.base
            ):
                raise InputError(
                    f"ArmConfig.base = {self.base!r} must be four numbers, x, y, z and yaw, or None"
                )
