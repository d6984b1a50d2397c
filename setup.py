"""What pyproject.toml cannot say: packages that are installed under other names, or not at all.

`agents`, `baselines` and `experiments` are too general for site-packages (`agents` is another
package there). The experiments, the project's own research, and what writes the pages in `docs` are
in a checkout that is installed with ``pip install -e``, not in a wheel.

``MS_SLAM_ENV_URL`` is the address of the published repository, where a package index can lead to.
"""

import os
import re
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

RENAMED = {
    "ms_slam_agents": "agents",
    "ms_slam_baselines": "baselines",
    "ms_slam_docs": "docs/site",
    "ms_slam_experiments": "experiments",
}
CHECKOUT_ONLY = ("ms_slam_docs", "ms_slam_experiments")
URL = os.environ.get("MS_SLAM_ENV_URL", "").rstrip("/")
PLACES = {
    "Homepage": "",
    "Documentation": "/blob/HEAD/docs/index.md",
    "Changelog": "/blob/HEAD/CHANGELOG.md",
    "Issues": "/issues",
}


def readme() -> str:
    """README.md for an index, on whose pages links into the repository would be dead.

    They become absolute, or their text alone where nobody said where the repository is.
    """
    text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    picture, link = (rf"{mark}\[([^]]*)\]\((?!https?:|#)([^)]*)\)" for mark in ("!", ""))
    text = re.sub(picture, rf"![\1]({URL}/raw/HEAD/\2)" if URL else r"(Picture: \1)", text)
    return re.sub(link, rf"[\1]({URL}/blob/HEAD/\2)" if URL else r"\1", text)


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
    long_description=readme(),
    long_description_content_type="text/markdown",
    project_urls={name: URL + place for name, place in PLACES.items() if URL},
)
