"""Mean Kullback-Leibler divergence over spatial windows."""

from __future__ import annotations

from ms_slam_env.divergence.kl import KLDivergence


class WindowedKLDivergence(KLDivergence):
    """Histograms per window of a ``config.windows`` grid, divergences averaged over windows.

    "Introducing spatial windowing across the image for histogram generation" (Saeedi et al.,
    ICRA 2017, section VII): two images with equal histograms but moved content then differ. The
    counter splits the image, and the mean over windows is that of the base class.
    """
