"""A folder of results as one HTML page that needs nothing else: no network, no other file."""

from ms_slam_env.benchmark.report.write import write_report

__all__ = ["write_report"]
