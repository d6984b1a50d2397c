"""The comparison with other SLAM systems: peers, report, bad input."""

from pathlib import Path

import pytest
from box_scene import BoxScene

from ms_slam_env.benchmark.slam_peers import (
    PeerResult,
    available_peers,
    main,
    parse_sequence,
    run_peer,
)
from ms_slam_env.benchmark.slam_peers_open3d import Open3DSlam
from ms_slam_env.benchmark.slam_peers_opencv import OpenCVOdometry
from ms_slam_env.benchmark.slam_peers_report import markdown_report
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import Sequence, handheld_trajectory, render_sequence

K = xtion("160x120")


@pytest.fixture(scope="module")
def sequence(box_scene: BoxScene) -> Sequence:
    poses = handheld_trajectory(box_scene, 12, seed=0)
    return render_sequence(box_scene, poses, K, noise="none")


@pytest.mark.parametrize(("maker", "limit_m"), [(OpenCVOdometry, 0.005), (Open3DSlam, 0.03)])
def test_peers_track_a_clean_sequence(sequence: Sequence, maker, limit_m: float) -> None:
    try:
        peer = maker(K)
    except (ImportError, OSError) as error:
        pytest.skip(f"{maker.name} cannot run here: {error}")
    first = run_peer(peer, sequence, "160x120")
    assert first.ate_rmse_m < limit_m
    assert first.path_m > 0.05
    # Reset forgets the first run; Open3D adds up in another order each time, and differs by 1 mm.
    again = run_peer(peer, sequence, "160x120")
    assert again.ate_rmse_m == pytest.approx(first.ate_rmse_m, abs=limit_m / 5)


def test_a_peer_that_cannot_be_imported_steps_aside(monkeypatch, capsys) -> None:
    def fail(*_: object) -> None:
        raise ImportError("no libGL")

    monkeypatch.setattr(Open3DSlam, "__init__", fail)
    missing: dict[str, str] = {}
    names = [peer.name for peer in available_peers("surfel", K, missing)]
    assert names == ["surfel", "opencv"]
    assert missing == {"open3d": "no libGL"}
    assert capsys.readouterr().err.splitlines() == ["open3d steps aside: no libGL"]


def test_the_table_holds_every_result_and_the_medians() -> None:
    errors = {"ours": (0.001, 0.002, 0.009), "other": (0.004, 0.005, 0.006)}
    results = [
        PeerResult(system, f"room:{k}", "160x120", error, error / 2, 5.0, 6.0, 3.0).__dict__
        for system, values in errors.items()
        for k, error in enumerate(values)
    ]
    text = markdown_report(
        {
            "provenance": {"command": "slam_peers"},
            "settings": {"ours": "defaults"},
            "missing": {"open3d": "not installed"},
            "results": results,
            "growth": [
                {
                    "sequence": "room:0",
                    "surfels_after_pass": [100, 103],
                    "growth": 0.03,
                    "lost_frames": 0,
                }
            ],
        }
    )
    assert "2.00 (1.00), 5.0 ms | 5.00 (2.50), 5.0 ms" in text
    assert "9.00 (4.50)" in text
    assert "+3.0 %" in text
    assert "open3d did not run: not installed" in text


@pytest.mark.parametrize("text", ["table", "table:x", "table:-1", ":"])
def test_a_malformed_sequence_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="scene:seed"):
        parse_sequence(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--sequences", "attic:0", "--sizes", "80x60"), "unknown scene 'attic'"),
        (("--frames", "3"), r"SlamPeersConfig.frames = 3 is outside \[10, 100000\]"),
        (("--frame", "30"), "--frame"),
    ],
)
def test_bad_input_is_one_line(arguments, message: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("ms_slam_env.benchmark.slam_peers.limit_threads", lambda _: None)
    with pytest.raises(InputError, match=message) as caught:
        main(["--out", str(tmp_path), *arguments])
    assert "\n" not in str(caught.value)
