"""Options of the divergence between two frames."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import check_choice, check_range
from ms_slam_env.errors import InputError

MEASURES = ("kl", "windowed-kl", "earth-movers")


@dataclass(frozen=True)
class DivergenceConfig:
    """How the histograms of a frame are made and compared.

    The defaults are those under which the divergence predicted from the map follows the one that
    is met (``python -m ms_slam_env.benchmark.fidelity``).

    Attributes:
        measure: ``kl`` (equations (5) and (10) of Saeedi et al., ICRA 2017), ``windowed-kl`` (its
            mean over spatial windows) or ``earth-movers``; the last two are improvements that the
            paper proposes in its section VII.
        bins: intensity bins P of equation (5), 2 to 256.
        smoothing: standard deviation of the Parzen window that smooths the intensity histogram,
            in grey levels; 0 = none.
        pseudo_count: pixels added to every bin before a histogram is normalised, so that no bin
            is empty and the logarithm of (5) and (10) is finite. The paper does not say what it
            does with empty bins.
        intensity_pixels: ``all``, or only those ``with-depth``. In a view predicted from a map
            the pixels without depth are holes, whose intensity (0) is not that of any surface.
        inclinations: N of equation (6).
        alpha_deg: influence angle alpha of equation (8), degrees.
        normal_reach_deg: angle, seen from the camera, to the neighbours on both sides whose depths
            give a pixel's normal; at least one pixel. Sensor noise tilts the normals the less the
            longer it is; as an angle it is the same surface at every image size.
        edge_threshold: relative second difference of inverse depth above which two pixels are
            taken to lie on different surfaces, so that no normal is computed across.
        windows: rows and columns of spatial windows (``windowed-kl`` only).

    Raises:
        InputError: a value outside its range.
    """

    measure: str = "kl"
    bins: int = 64
    smoothing: float = 4.0
    pseudo_count: float = 0.5
    intensity_pixels: str = "with-depth"
    inclinations: int = 4
    alpha_deg: float = 45.0
    normal_reach_deg: float = 1.4
    edge_threshold: float = 0.05
    windows: tuple[int, int] = (2, 2)

    def __post_init__(self) -> None:
        """Refuse values that make no histogram."""
        check_choice(self, "measure", MEASURES)
        check_choice(self, "intensity_pixels", ("all", "with-depth"))
        check_range(self, "bins", 2, 256)
        check_range(self, "smoothing", 0, 64)
        check_range(self, "pseudo_count", 1e-6, 1e3)
        check_range(self, "inclinations", 2, 32)
        check_range(self, "alpha_deg", 1, 90)
        check_range(self, "normal_reach_deg", 0, 10)
        check_range(self, "edge_threshold", 1e-4, 1)
        is_grid = isinstance(self.windows, (tuple, list)) and len(self.windows) == 2
        if not is_grid or not all(isinstance(n, int) and 1 <= n <= 16 for n in self.windows):
            raise InputError(
                f"DivergenceConfig.windows = {self.windows!r} must be two integers in [1, 16]"
            )
        object.__setattr__(self, "windows", tuple(self.windows))  # lists come from YAML

    @classmethod
    def paper(cls) -> DivergenceConfig:
        """The paper's own setting: 256 intensity bins, no smoothing, all pixels, plain KL.

        The paper gives no numbers for N and alpha, 8 and 30 degrees are ours; normals come from
        the next pixels.
        """
        return cls(
            measure="kl",
            bins=256,
            smoothing=0.0,
            intensity_pixels="all",
            inclinations=8,
            alpha_deg=30.0,
            normal_reach_deg=0.0,
        )
