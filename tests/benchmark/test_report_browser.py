"""A report in a real browser: no errors, no network, figures, sorting, a phone."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.benchmark.report import write_report

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
def report(tmp_path_factory):
    """A report of several results, one of them hostile."""
    folder = tmp_path_factory.mktemp("results")
    rng = np.random.default_rng(0)
    backends, sequences = ("surfel", "odometry"), [f"living_room:{2000 + k}" for k in range(12)]
    summary = [
        {
            "image_size": "160x120",
            "sequence": sequence,
            "backend": backend,
            "error": None,
            "ate_m": float(rng.uniform(0.001, 0.2)),
            "cpu_ms": float(rng.uniform(3, 30)),
        }
        for sequence in sequences
        for backend in backends
    ]
    contents = {
        "compare/compare.json": {"summary": summary, "provenance": {"command": "ms-slam compare"}},
        "divergence/divergence.json": {
            "sequences": [
                {
                    "sequence": HOSTILE,
                    "times_s": np.linspace(0, 9, 90).tolist(),
                    "depth": rng.random(90).tolist(),
                    "intensity": rng.random(90).tolist(),
                }
            ]
        },
        "other/other.json": {
            "provenance": {"command": HOSTILE},
            "rows": [
                {"variant": name, "number": number, "wide_" + 40 * "x": HOSTILE}
                for name, number in ((HOSTILE, 10.0), ("b", 9.0), ("c", None), ("d", -100.0))
            ],
        },
    }
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir()
        path.write_text(json.dumps(content))
    Image.new("RGB", (1600, 300)).save(folder / "other/wide.png")
    (folder / "other/table.md").write_text(
        f"{HOSTILE}\n\n| a{HOSTILE} | b |\n| --- | --- |\n| 1 | 2 |\n"
    )
    return write_report(folder)


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=BROWSER, headless=True, args=ARGUMENTS)
        yield started
        started.close()


class Visit:
    """An open page, with what it said and what it asked the network for."""

    def __init__(self, browser, path, **options):
        self.context = browser.new_context(offline=True, **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        self.problems, self.requests = [], []
        self.page.on("console", self.console)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("html[data-ready=yes]", state="attached")

    def console(self, message):
        if message.type in ("error", "warning"):
            self.problems.append(message.text)

    def column(self, table, index):
        script = "(t, k) => [...t.tBodies[0].rows].map((row) => row.cells[k].textContent)"
        return self.page.eval_on_selector(table, script, index)


@pytest.fixture(scope="module")
def visit(browser, report):
    found = Visit(browser, report, viewport={"width": 1280, "height": 800})
    yield found
    found.context.close()


def test_loads_from_a_file_without_errors_and_without_network(visit, report):
    assert visit.problems == []
    outside = [url for url in visit.requests if not url.startswith(("data:", "blob:"))]
    assert outside == [report.as_uri()]


def test_every_figure_is_drawn(visit):
    counts = visit.page.evaluate(
        "[...document.querySelectorAll('figure.plot')].map("
        "(f) => f.querySelectorAll('svg.main-svg .trace, svg.main-svg .bars').length)"
    )
    assert len(counts) == 4  # error against time, every sequence, divergence, other
    assert all(count > 0 for count in counts)


def test_a_choice_draws_another_measure(visit):
    select = visit.page.locator("figure.plot select").first
    axis = visit.page.locator("figure.plot:has(select) .xtitle").first
    before = axis.text_content()
    select.select_option(index=1)
    visit.page.wait_for_function(
        "(old) => document.querySelector('figure.plot:has(select) .xtitle').textContent !== old",
        arg=before,
    )
    assert (before, axis.text_content()) == ("ATE [mm]", "CPU [ms]")


def test_a_click_sorts_numbers_as_numbers(visit):
    table = "#s3 details.table table"
    visit.page.locator("#s3 details.table summary").first.click()
    button = visit.page.locator(f"{table} th button", has_text="number")
    numbers = visit.page.eval_on_selector(
        table, "(t) => [...t.tHead.rows[0].cells].findIndex((c) => c.innerText.includes('number'))"
    )
    button.click()
    assert visit.column(table, numbers) == ["-100.0", "9.000", "10.00", "–"]
    button.press("Enter")
    assert visit.column(table, numbers) == ["10.00", "9.000", "-100.0", "–"]
    head = button.locator("xpath=..")
    assert head.get_attribute("aria-sort") == "descending"


def test_hostile_text_is_text(visit):
    assert visit.page.evaluate("typeof owned") == "undefined"
    assert visit.page.locator("img[src=x]").count() == 0
    assert visit.page.get_by_text(HOSTILE).count() > 0


def test_a_phone_scrolls_tables_not_the_page(browser, report):
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
