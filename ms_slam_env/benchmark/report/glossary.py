"""What columns mean: heading, unit and a sentence, from a key (``ate_m``) or a heading."""

from __future__ import annotations

import re
from collections.abc import Sequence

Meanings = Sequence[tuple[str, str]]
"""Pairs of a pattern and a sentence; the first that matches holds."""

MEANINGS: Meanings = (
    (
        r"^ate max|^largest|^max(imum)? ate",
        "Largest distance between an estimated and the true position.",
    ),
    (
        r"^ate unaligned|running ate",
        "Absolute trajectory error without any alignment: both trajectories start together.",
    ),
    (
        r"^(final ate|ate,? final)",
        "Absolute trajectory error of the poses as the finished map has them.",
    ),
    (r"^ate ratio", "ATE divided by that of the first variant."),
    (
        r"^ate\b|\bate$",
        "Absolute trajectory error: root mean square distance between estimated and true "
        "positions, after a rigid alignment unless stated otherwise.",
    ),
    (r"^rpe\b", "Relative pose error: root mean square error of the motion between two frames."),
    (r"^rer\b", "Reconstruction error: root mean square distance of map points from the surface."),
    (
        r"^rcm\b|^completeness",
        "Reconstruction completeness: share of the true surface that has a map point nearby.",
    ),
    (
        r"^f ?\d+ ?cm|^f.?score|interquartile mean f",
        "Harmonic mean of the precision and the recall of the map at the stated distance.",
    ),
    (r"^precision", "Share of map points within the stated distance of the true surface."),
    (r"^recall", "Share of the true surface within the stated distance of a map point."),
    (r"^map error", "Mean distance of map points from the true surface."),
    (r"^hausdorff", "Largest distance from a point of one cloud to the other cloud."),
    (r"^(c2c|cloud to cloud)", "Distance from a map point to the nearest true one (USME 6)."),
    (r"^accuracy", "Mean distance from a map point to the true surface."),
    (r"^completion ratio", "Share of the true surface that has a map point within the distance."),
    (r"^completion", "How much of the true surface has a map point nearby, or its mean distance."),
    (r"^spacing", "Distance between neighbouring points of the map."),
    (r"^(drift|of the path|end error|at the end)", "Error at the end, or its share of the path."),
    (
        r"^robustness",
        "How differently the pieces between lost frames align with the truth (USME 10).",
    ),
    (r"^initialisation", "Time until the scale of the estimate is steady (USME 12)."),
    (r"^scale error", "Symmetric relative error of the scale (USME 13)."),
    (
        r"^noise ratio",
        "Noise ratio (USME 8): share of map points that statistical outlier removal takes away.",
    ),
    (r"frames lost|^lost (frames|steps)", "Frames for which SLAM had no pose, or their share."),
    (r"^lost\b", "Whether, or in which share of episodes, tracking was lost."),
    (r"^success", "Share of episodes whose map shows nothing twice."),
    (r"^(cpu|processor|frame cpu)\b|^frame ms", "Processor time a frame, all threads together."),
    (r"^ext( ms)?$", "Execution time: mean time of SLAM a frame, by the clock."),
    (
        r"^ext ms (median|p95|p99|max)$",
        "Execution time of a frame, by the clock: median, percentile or largest of the frames.",
    ),
    (r"^ext (quiet|violent)( ms)?$", "Mean processor time of a frame in such stretches."),
    (r"^mem peak( mb)?$", "Memory that SLAM itself took, at its peak."),
    (r"^mem process( mb)?$", "Memory of the whole process at its peak."),
    (r"^mem(ory)?\b|^peak mem", "Memory of the process at its peak, unless stated otherwise."),
    (r"^ene(rgy)?\b", "Energy, measured or by the stated model."),
    (r"^(clock|wall)( ms( p\d+)?)?$|^ms( median| p95)?$", "Time a frame."),
    (r"^path( length)?(,? m)?$", "Length of the path."),
    (r"^decision", "Time the planner took to choose a motion."),
    (r"^m i$", "Mean intensity divergence of the chosen motions, nats."),
    (r"^m d$", "Mean depth divergence of the chosen motions, nats."),
    (
        r"^mean (i|d)$|^(intensity|depth)$|^(mean (intensity|depth) )?divergences?$",
        "Kullback-Leibler divergence between the histograms of two frames, nats: how much new "
        "the second one shows.",
    ),
    (r"^return\b", "Sum of the rewards of an episode."),
    (r"^mapped( area)?", "Area of the true surface that the map covers."),
    (
        r"^points per level$",
        "Pixels that tracking looks at in its last iteration; the others look at three tenths.",
    ),
    (r"^surfels( stored)?$|^(map )?points$", "Surface points that the map holds."),
    (r"^found\b", "Share of attempts in which a lost camera was found again."),
    (r"^wrong\b", "Share of the answers that were wrong."),
    (r"^relocalisation", "Time from the first frame with something to see to a pose."),
    (r"^p\(better", "Probability that an episode is better than one of the other planner."),
    (r"^error$", "Why this one failed; empty where it did not."),
    (r"^elapsed", "Time by the clock that this row took."),
    (r"^hypervolume", "Size of the region that the Pareto front dominates; more is better."),
    (
        r"^importance( of)?$",
        "Share of the parameter in what makes a good value of the objective (PED-ANOVA).",
    ),
    (r"^processed frames$", "Number of frames that SLAM processed."),
    (
        r"^share|share$|^processed$|^kept frames$",
        "A share: from 0 to 1, or in per cent where it says so.",
    ),
    (r"^seed$", "Seed of scene, path and noise: the same seed gives the same data."),
    (r"^noise$", "Noise model of the depth camera."),
    (r"^(planner|backend|system|variant|setting|policy)$", "What is compared."),
    (r"^(scene|sequence|recording)$", "What it ran on."),
    (r"^frames?$", "Frames that were given."),
    (r"^(attempts|episodes|cases|values|count|states|motions)$", "Number of observations."),
    (r"^value$", "Value of what the row names."),
    (r"^(low|high)$", "End of the 95 % interval."),
)
"""Pattern of a key or heading (lower case, blanks for underscores, without unit); sentence."""

_SMALL_DISTANCES = r"(ate|rpe|rer|map_error|error|end|largest|accuracy|completion|hausdorff)"
_UNITS = (
    (r"_m_s$", "m/s", 1.0),
    (r"_deg_s$", "deg/s", 1.0),
    (r"_per_s$", "1/s", 1.0),
    (r"_deg_per_m$", "deg/m", 1.0),
    (r"_mm$", "mm", 1.0),
    (r"(^|_)ms$", "ms", 1.0),
    (r"_m2$", "m²", 1.0),
    (r"_mb$", "MB", 1.0),
    (r"_j$", "J", 1.0),
    (r"_mj$", "mJ", 1.0),
    (r"_rad$", "rad", 1.0),
    (r"_mrad$", "mrad", 1.0),
    (r"_deg$", "deg", 1.0),
    (r"_s$", "s", 1.0),
    (rf"^(final_|mean_|median_|team_|map_|regular_)?{_SMALL_DISTANCES}([a-z_]*)_m$", "mm", 1000.0),
    (r"_m$", "m", 1.0),
    (r"_share$", "%", 100.0),
    (r"^(map_|regular_)?((f|f_score|precision|recall)_\d+cm|rcm(_tracked)?)$", "%", 100.0),
)  # pattern of a key; unit that its values are shown in; factor to it
_CAPITALS = re.compile(r"\b(ate|rpe|rer|rcm|ext|mem|ene|icp|rgb|cpu|gpu|fps)\b")


def meaning(name: str, own: Meanings = ()) -> str:
    """What the column of a key or heading means; empty where that is not known.

    Args:
        name: key or heading.
        own: of a kind of result, before ``MEANINGS``. A pattern is one of all of the name, unit
            included, in lower case with blanks for underscores; an empty sentence: no explanation.
    """
    whole = name.lower().replace("_", " ")
    for pattern, text in own:
        if re.fullmatch(pattern, whole):
            return text
    plain = re.sub(r"\[.*?\]|%", " ", whole)
    for part in reversed(re.split(r"\.|: ", plain)):
        words = " ".join(part.split())
        for pattern, text in MEANINGS:
            if re.search(pattern, words):
                return text
    return ""


def unit(key: str) -> tuple[str, float]:
    """Unit that a key's values are shown in, and the factor to it: ``ate_m.median`` has one too."""
    for part in reversed(key.split(".")):
        for pattern, name, scale in _UNITS:
            if re.search(pattern, part):
                return name, scale
    return "", 1.0


def heading(key: str) -> str:
    """Heading of a key: ``final.ate_m`` -> ``final: ATE [mm]``."""
    *prefix, last = key.split(".")
    name, _ = unit(key)
    label = ": ".join([*(_words(part) for part in prefix), _words(last)])
    return f"{label} [{name}]" if name else label


def with_unit(label: str) -> str:
    """A heading whose last words are a unit, with that in brackets: ``turn deg s``."""
    match = re.fullmatch(r"([a-z ]+?) (deg s|m s|per s|m)", label)
    return f"{match[1]} [{unit('_' + match[2].replace(' ', '_'))[0]}]" if match else label


def _words(key: str) -> str:
    for pattern, *_ in _UNITS:
        if pattern.startswith(("_", "(^|_)")):
            shorter = re.sub(pattern, "", key)
            if shorter != key and shorter:
                key = shorter if pattern != "_share$" else key
                break
    key = re.sub(r"^(ate|rpe|rer|map_error)_m$", r"\1", key)
    key = re.sub(r"\bf(_score)?_(\d+)cm", r"F-score \2 cm", re.sub(r"^(map|team)_", r"\1 ", key))
    key = re.sub(r"(\d)cm\b", r"\1 cm", key).replace("_", " ")
    if re.fullmatch(r"(M|mean) [ID]", key):
        return key.replace(" ", "_")
    return _CAPITALS.sub(lambda match: match[1].upper(), key)
