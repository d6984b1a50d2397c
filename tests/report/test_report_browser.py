"""A report in a real browser: no errors, no network, figures, sorting, a phone."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.report.charts import Chart, Guide, Panel, Series
from ms_slam_env.report.page import write_report
from ms_slam_env.report.results import write_results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Column, make_table

pytest.importorskip("plotly")
playwright = pytest.importorskip("playwright.sync_api")

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next((path for path in map(shutil.which, NAMES) if path), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(NAMES)} is installed"),
]
HOSTILE = "</script><script>owned=1</script><img src=x onerror=owned=1>"
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of two results, one of them hostile and out of date."""
    folder = tmp_path_factory.mktemp("results")
    rng = np.random.default_rng(0)
    backends = ("surfel", "odometry")
    sequences = [f"living_room:{2000 + k}" for k in range(12)]

    def bars(key: str) -> Panel:
        series = [Series(b, rng.random(12).tolist(), sequences, mode="bars") for b in backends]
        return Panel(key, "", series)

    steps = list(range(1, 91))
    middle = rng.uniform(0.001, 0.1, 90)
    line = Series(
        HOSTILE,
        steps,
        middle.tolist(),
        (middle / 2).tolist(),
        (middle * 2).tolist(),
        "lines",
        [HOSTILE] * 90,
    )
    dots = Series(
        HOSTILE, [0.1, 0.2], [HOSTILE, "b"], [0.05, 0.1], [0.2, 0.4], "markers", ["a", "b"]
    )
    plan = Series("truth", [0, 1], [0, 1], mode="lines")
    write_results(
        folder / "compare/results.json",
        "compare",
        "Comparison",
        "Backends over sequences.",
        [make_table(["sequence", "ate_m"], [{"sequence": s, "ate_m": 0.1} for s in sequences])],
        [Chart("c", "Measures", "Bars.", [bars("ate_m"), bars("cpu_ms_median")])],
    )
    values = ((HOSTILE, 10.0), ("b", 9.0), ("c", None), ("d", -100.0), ("e", math.inf))
    other = folder / "other/results.json"
    write_results(
        other,
        HOSTILE,
        HOSTILE,
        HOSTILE,
        [
            make_table(
                ["variant", "return", Column("wide", "variant", "wide_" + 40 * "x")],
                [{"variant": v, "return": n, "wide": HOSTILE} for v, n in values],
                HOSTILE,
                HOSTILE,
            )
        ],
        [
            Chart(
                "l",
                HOSTILE,
                HOSTILE,
                [Panel("steps", "ate_m", [line], "y", [Guide(0.05, "y", HOSTILE)], HOSTILE)],
            ),
            Chart("d", "Dots", "Dots.", [Panel("ate_m", "", [dots])]),
            Chart("p", "Plan", "Plan.", [Panel("path_m", "path_m", [plan], equal=True)]),
        ],
    )
    other.write_text(other.read_text().replace('"results_version": 2', '"results_version": 1'))
    Image.new("RGB", (1600, 300)).save(folder / "other/wide.png")
    (folder / "other/config.yaml").write_text(HOSTILE)
    (folder / f"{HOSTILE.replace('/', '')}.json").write_text("{}")
    return write_report(folder)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=BROWSER, headless=True, args=ARGUMENTS)
        yield started
        started.close()


class Visit:
    """An open page, with what it said and what it asked the network for."""

    def __init__(self, browser: Any, path: Path, **options: Any) -> None:
        self.context = browser.new_context(offline=True, **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        self.problems: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self.console)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("html[data-ready=yes]", state="attached")

    def console(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.problems.append(message.text)

    def column(self, table: str, index: int) -> list[str]:
        script = "(t, k) => [...t.tBodies[0].rows].map((row) => row.cells[k].textContent)"
        return list(self.page.eval_on_selector(table, script, index))


@pytest.fixture(scope="module")
def visit(browser: Any, report: Path) -> Iterator[Visit]:
    found = Visit(browser, report, viewport={"width": 1280, "height": 800})
    yield found
    found.context.close()


def test_loads_from_a_file_without_errors_and_without_network(visit: Visit, report: Path) -> None:
    assert visit.problems == []
    outside = [url for url in visit.requests if not url.startswith(("data:", "blob:"))]
    assert outside == [report.as_uri()]


def test_every_figure_is_drawn(visit: Visit) -> None:
    counts = visit.page.evaluate(
        "[...document.querySelectorAll('figure.plot')].map("
        "(f) => f.querySelectorAll('svg.main-svg .trace, svg.main-svg .bars').length)"
    )
    assert len(counts) == 4
    assert all(count > 0 for count in counts)


def test_a_guide_is_where_it_should_be_on_a_logarithmic_axis(visit: Visit) -> None:
    drawn, expected = visit.page.evaluate(
        "(() => { const canvas = document.querySelector('#s2-c0 .canvas');"
        " const axis = canvas._fullLayout.yaxis;"
        " const line = canvas.querySelector('.shapelayer path').getBBox();"
        " return [line.y + line.height / 2, axis._offset + axis.d2p(50)]; })()"
    )
    assert drawn == pytest.approx(expected, abs=1)


def test_a_choice_draws_another_measure(visit: Visit) -> None:
    select = visit.page.locator("figure.plot select").first
    axis = visit.page.locator("figure.plot:has(select) .xtitle").first
    before = axis.text_content()
    select.select_option(index=1)
    visit.page.wait_for_function(
        "(old) => document.querySelector('figure.plot:has(select) .xtitle').textContent !== old",
        arg=before,
    )
    assert (before, axis.text_content()) == ("ATE [mm]", "processor time [ms]")


def test_a_click_sorts_numbers_as_numbers(visit: Visit) -> None:
    button = visit.page.locator("#s2-t0 th button", has_text="return")
    button.click()
    assert visit.column("#s2-t0", 1) == ["-100", "9.0", "10", "never", "-"]
    button.press("Enter")
    assert visit.column("#s2-t0", 1) == ["never", "10", "9.0", "-100", "-"]
    head = button.locator("xpath=..")
    assert head.get_attribute("aria-sort") == "descending"


def test_hostile_text_is_text(visit: Visit) -> None:
    assert visit.page.evaluate("typeof owned") == "undefined"
    assert visit.page.locator("img[src=x]").count() == 0
    assert visit.page.get_by_text(HOSTILE).count() > 0


ODD = (
    *(
        "$x^{2}$ $\\frac{a}{",
        "a|b",
        "lone \ud800",
        "\u202egnp.exe",
        "L" * 3000,
        "`[x](javascript:0)",
    ),
    *("__proto__", "constructor", "<b>&lt;", "\0\x1b[31m", "\u05d0\u05d1"),
)
"""Names with a meaning elsewhere: to formulas, tables, text directions, Markdown, JavaScript."""


def test_names_with_a_meaning_elsewhere_are_names(browser: Any, tmp_path: Path) -> None:
    bars = Panel("ate_m", "", [Series("s", [0.1] * len(ODD), ODD, mode="bars")])
    lines = [Series(name, [0, 1], [0.1, 0.2], mode="lines") for name in ODD]
    charts = [Chart("b", ODD[0], ODD[3], [bars]), Chart("l", "", "", [Panel("ate_m", "", lines)])]
    rows = [{"variant": name, "ate_m": 0.1} for name in ODD]
    folder = tmp_path / ODD[0].replace("/", "") / "a|b"
    table = make_table(["variant", "ate_m"], rows, ODD[3], ODD[1])
    write_results(folder / "results.json", ODD[2], ODD[1], ODD[3], [table], charts)
    visit = Visit(browser, write_report(tmp_path), viewport={"width": 1280, "height": 800})
    drawn = visit.page.evaluate("document.querySelectorAll('#s1-c0 .bars .point').length")
    wide = visit.page.evaluate("document.documentElement.scrollWidth")
    shown = visit.column("#s1-t0", 0)
    visit.context.close()
    assert [text for text in visit.problems if "MathJax" not in text] == []
    assert (drawn, wide) == (len(ODD), 1280)
    assert len(set(shown)) == len(ODD)
    assert "\ufffdgnp.exe" in shown


def test_a_phone_scrolls_tables_not_the_page(browser: Any, report: Path) -> None:
    phone = Visit(
        browser,
        report,
        viewport={"width": 390, "height": 844},
        is_mobile=True,
        has_touch=True,
        color_scheme="dark",
    )
    phone.page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    width, inner = phone.page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    too_wide = phone.page.evaluate(
        "[...document.querySelectorAll('.canvas .main-svg')].filter((s) => "
        "s.getBoundingClientRect().right > innerWidth + 1).length"
    )
    ground = phone.page.evaluate("getComputedStyle(document.body).backgroundColor")
    phone.context.close()
    assert (width, inner, too_wide) == (390, 390, 0)
    assert ground == "rgb(20, 24, 28)"
    assert phone.problems == []


@pytest.mark.parametrize("width", [1280, 390])
def test_columns_out_of_sight_are_counted(browser: Any, tmp_path: Path, width: int) -> None:
    names = ("path", "ate", "ate_max", "rpe", "ate_mean", "ate_median", "ate_std")
    keys = [f"{name}_m" for name in names]
    row = dict.fromkeys(keys, Interval(0.001234, 0.000123, 0.01234))
    wide = [Column(f"{k}{n}", k) for n in range(3) for k in keys]
    tables = [
        make_table(["sequence", *keys], [{"sequence": "living_room:2000:kinect", **row}]),
        make_table(["sequence", *wide], [{"sequence": "x", **{c.name: row[c.key] for c in wide}}]),
    ]
    write_results(tmp_path / "results.json", "k", "wide", "", tables=tables)
    page = Visit(browser, write_report(tmp_path), viewport={"width": width, "height": 800})
    found = page.page.evaluate(
        "[...document.querySelectorAll('.scroll')].map((box) => ["
        "[...box.querySelectorAll('th')].filter((h) => h.getBoundingClientRect().right > "
        "box.getBoundingClientRect().right + 5).length, box.previousSibling.textContent])"
    )
    page.page.locator(".scroll").nth(1).evaluate("(box) => { box.scrollLeft = 1e6; }")
    page.page.wait_for_selector(".scroll:not([data-more]) >> nth=0")
    page.page.wait_for_timeout(100)
    at_the_end = page.page.locator(".more").nth(1).text_content()
    page.context.close()
    (fits, first), (out, second) = found
    if width == 1280:  # eight columns of values with intervals
        assert (fits, first) == (0, "")
    else:
        assert first == f"{fits} more columns to the right →"
    assert out > 3
    assert second == f"{out} more columns to the right →"
    assert at_the_end == ""


def test_a_logarithmic_axis_has_plain_numbers_and_the_mode_bar_covers_nothing(
    browser: Any, tmp_path: Path
) -> None:
    def chart(name: str, low: float, high: float) -> Chart:
        values = np.geomspace(low, high, 20).tolist()
        panel = Panel("cpu_ms_mean", "lost_share", [Series("a", values, values)], log="x")
        return Chart(name, name, "Caption.", [panel])

    wide = chart("wide", 5, 500), chart("narrow", 12, 30), chart("huge", 0.01, 1e4)
    table = make_table(["sequence", "ate_m"], [{"sequence": "s", "ate_m": 0.1}])
    write_results(tmp_path / "results.json", "compare", "Title", "About.", [table], wide)
    page = browser.new_page(viewport={"width": 900, "height": 1600})
    page.goto(write_report(tmp_path, None).as_uri())
    page.wait_for_selector("html[data-ready=yes]")
    labels = page.eval_on_selector_all(
        ".canvas",
        "all => all.map(c => [...c.querySelectorAll('.xtick text')].map(t => t.textContent))",
    )
    assert labels[0] == ["5", "10", "20", "50", "100", "200", "500"]
    assert len(labels[1]) > 3
    assert all(12 <= float(label) <= 30 for label in labels[1])
    assert labels[2] == ["0.01", "0.1", "1", "10", "100", "1,000", "10,000"]
    page.hover(".canvas >> nth=0")
    bar = page.locator(".modebar").first.bounding_box()
    plot = page.locator(".canvas .nsewdrag").first.bounding_box()
    assert bar["x"] >= plot["x"] + plot["width"]
    page.close()
