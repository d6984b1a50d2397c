"""Finding the pose again once tracking is lost: from keyframes anywhere in the map, or not."""

from ms_slam_env.slam.surfel.relocalisation.base import Images, Relocalisation, Searcher
from ms_slam_env.slam.surfel.relocalisation.keyframes import FernRelocalisation
from ms_slam_env.slam.surfel.relocalisation.local import LocalSearch
from ms_slam_env.slam.surfel.relocalisation.make import make_relocalisation

__all__ = [
    "FernRelocalisation",
    "Images",
    "LocalSearch",
    "Relocalisation",
    "Searcher",
    "make_relocalisation",
]
