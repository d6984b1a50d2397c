"""The JSON schema of configuration files agrees with what reads them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import (
    SlamConfiguration,
    read_configuration,
    write_configuration,
)
from ms_slam_env.slam.configuration_schema import configuration_schema, schema_of
from ms_slam_env.slam.registry import check_parameters
from ms_slam_env.slam.surfel import SurfelConfig

jsonschema = pytest.importorskip("jsonschema")
SCHEMA = configuration_schema()
CHECK = jsonschema.Draft202012Validator(SCHEMA)


def is_read(folder: Path, content: object) -> bool:
    path = folder / "slam.yaml"
    path.write_text(yaml.safe_dump(content))
    try:
        read_configuration(path)
    except InputError:
        return False
    return True


def test_the_command_writes_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    page = (Path(__file__).resolve().parents[2] / "docs/slam.md").read_text()
    (module,) = re.findall(r"^python -m (ms_slam_env\S*) > slam.schema.json$", page, re.MULTILINE)
    done = subprocess.run([sys.executable, "-m", module], capture_output=True, check=True)
    assert json.loads(done.stdout) == SCHEMA


GOOD = [
    {},
    {"slam": "surfel", "slam_config": {"loops": {"window": 60}, "iterations": [4, 3, 2]}},
    {"slam_config": {"loop_closure": "deformation", "max_surfels": None, "device": "cpu"}},
    {"slam": "odometry", "image_size": "80x60", "keep_every": 3, "threads": 2, "cpu_mhz": None},
    {"compiler": {"fast_math": True}, "about": {"trial": 7}},
]
BAD = [
    [],
    {"slm": "surfel"},
    {"keep_every": 0},
    {"keep_every": 1.5},
    {"threads": "two"},
    {"slam_config": {"windw": 60}},
    {"slam_config": {"loops": {"windw": 60}}},
    {"slam_config": {"loops": {"window": 0}}},
    {"slam_config": {"loop_closure": "deform"}},
    {"slam_config": {"check_slips": 2}},
    {"slam": "odometry", "slam_config": {"loops": {}}},
    {"compiler": {"fast": True}},
]


@pytest.mark.parametrize("content", [*GOOD, *BAD], ids=str)
def test_files_are_valid_where_they_are_read(tmp_path: Path, content: object) -> None:
    assert CHECK.is_valid(content) == is_read(tmp_path, content) == (content in GOOD)


def test_what_is_written_is_valid(tmp_path: Path) -> None:
    path = tmp_path / "slam.yaml"
    write_configuration(path, SlamConfiguration(slam_config={"submaps": "off"}, keep_every=2))
    assert CHECK.is_valid(yaml.safe_load(path.read_text()))


def test_ranges_and_choices_are_those_of_the_options() -> None:
    """Both ends of every range are taken by both, and what is beyond by neither."""
    options = schema_of(SurfelConfig)["properties"]
    ranged = {name: about for name, about in options.items() if "minimum" in about}
    assert len(ranged) > 15
    for name, about in ranged.items():
        low, high = about["minimum"], about["maximum"]
        for value in (low - 1, low, high, high + 1):
            file = {"slam_config": {name: value}}
            try:
                check_parameters("surfel", {name: value})
                taken = True
            except InputError as error:
                taken = f"{name} = " not in str(error)  # refused for another option's sake
            assert taken == CHECK.is_valid(file) == (low <= value <= high), (name, value)
