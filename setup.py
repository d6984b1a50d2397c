"""What pyproject.toml cannot say: found packages beside two that are installed under other names.

`agents` and `baselines` are too general for site-packages (`agents` is another package there).
"""

from setuptools import find_packages, setup

RENAMED = {"ms_slam_agents": "agents", "ms_slam_baselines": "baselines"}

setup(packages=[*find_packages(include=["ms_slam_env*"]), *RENAMED], package_dir=RENAMED)
