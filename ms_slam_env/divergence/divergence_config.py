"""Options of the divergence between two frames."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError

MEASURES = ("kl", "windowed-kl", "earth-movers")


@dataclass(frozen=True)
class DivergenceConfig(Checked):
    """How a frame's histograms are computed and compared.

    With the defaults, the divergence predicted from the map follows the observed one (``ms-slam
    experiment lookahead_ranking``).

    Attributes:
        measure: ``kl`` (equations (5) and (10) of Saeedi et al., ICRA 2017), ``windowed-kl`` (its
            mean over spatial windows) or ``earth-movers``; the paper proposes the last two as
            improvements in section VII.
        bins: intensity bins P of equation (5), 2 to 256.
        smoothing: standard deviation in grey levels of the Parzen window that smooths the intensity
            histogram; 0 = none.
        pseudo_count: pixels added to every bin before normalisation, so that no bin is empty and
            the logarithm in (5) and (10) is finite. The paper does not say how it treats empty
            bins.
        intensity_pixels: ``all``, or only those ``with-depth``. In a view predicted from a map,
            pixels without depth are holes, whose intensity (0) belongs to no surface.
        inclinations: N of equation (6).
        alpha_deg: influence angle alpha of equation (8), degrees.
        normal_reach_deg: viewing angle to the neighbours on both sides whose depths determine a
            pixel's normal; at least one pixel. A larger reach makes normals less noisy. As an angle
            it covers the same surface at every image size.
        edge_threshold: relative second difference of inverse depth above which pixels belong to
            different surfaces, so that no normal is computed across.
        windows: rows and columns of spatial windows (``windowed-kl`` only).

    Raises:
        InputError: a value outside its range.
    """

    measure: str = chosen("kl", *MEASURES)
    bins: int = bounded(64, 2, 256)
    smoothing: float = bounded(4.0, 0, 64)
    pseudo_count: float = bounded(0.5, 1e-6, 1e3)
    intensity_pixels: str = chosen("with-depth", "all", "with-depth")
    inclinations: int = bounded(4, 2, 32)
    alpha_deg: float = bounded(45.0, 1, 90)
    normal_reach_deg: float = bounded(1.4, 0, 10)
    edge_threshold: float = bounded(0.05, 1e-4, 1)
    windows: tuple[int, int] = (2, 2)

    def __post_init__(self) -> None:
        """Refuse values that allow no histogram."""
        super().__post_init__()
        is_grid = isinstance(self.windows, (tuple, list)) and len(self.windows) == 2
        if not is_grid or not all(isinstance(n, int) and 1 <= n <= 16 for n in self.windows):
            raise InputError(
                f"DivergenceConfig.windows = {self.windows!r} must be two integers in [1, 16]"
            )
        object.__setattr__(self, "windows", tuple(self.windows))  # lists come from YAML

    @classmethod
    def paper(cls) -> DivergenceConfig:
        """The paper's own setting: 256 intensity bins, no smoothing, all pixels, plain KL.

        The paper gives no numbers for N and alpha; 8 and 30 degrees are our choice. Normals come
        from adjacent pixels.
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
