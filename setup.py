"""What pyproject.toml cannot say: packages that are installed under other names, or not at all.

`agents`, `baselines` and `experiments` are too general for site-packages (`agents` is another
package there). The experiments, the project's own research, and what writes the pages in `docs` are
in a checkout that is installed with ``pip install -e``, not in a wheel.
"""

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

RENAMED = {
    "ms_slam_agents": "agents",
    "ms_slam_baselines": "baselines",
    "ms_slam_docs": "docs/site",
    "ms_slam_experiments": "experiments",
}
CHECKOUT_ONLY = ("ms_slam_docs", "ms_slam_experiments")


class BuildPy(build_py):
    """Leave what belongs to a checkout out of what is not editable."""

    def finalize_options(self) -> None:
        """Tell by what setuptools says of the build."""
        super().finalize_options()
        if not self.editable_mode:
            self.packages = [name for name in self.packages if name not in CHECKOUT_ONLY]


setup(
    packages=[*find_packages(include=["ms_slam_env*"]), *RENAMED],
    package_dir=RENAMED,
    cmdclass={"build_py": BuildPy},
)
