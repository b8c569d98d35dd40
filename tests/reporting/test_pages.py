"""Reports with all pictures, as files, and in a real browser: all fits, and the motion plays."""

import base64
import json
import shutil
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pbrl_ppl.reporting import render, render_logs, render_posterior
from pbrl_ppl.reporting.words import number
from tests.helpers.html import Page, stands_alone
from tests.helpers.revised import every_verdict, revised

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
pytestmark = [
    pytest.mark.one_stack,
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
    # of the driver's pipes, when it ends
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


#: Rows of the page of many logs.
LOGS = [
    {"log": "cart #1", "verdict": "effects-added", "error_before": 12.34, "error_after": 1.012,
     "added": [f"{kind}_drag[cart]" for kind in ("linear", "angular", "quadratic")],
     "warnings": []},
    {"log": "lost_on_some_floor_of_a_house", "verdict": "failed", "added": [], "warnings": [],
     "message": "row 3: x is lost"},
    {"log": "told", "verdict": "adequate", "error_before": 1.0, "error_after": 1.0, "added": [],
     "warnings": ["rows were resampled"]},
]  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="no playwright: pip install pbrl_ppl[test]"
    )
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    pages = {
        "loop": render(revised()),
        "posterior": render_posterior(revised().posterior_after),
        "many": render_logs(LOGS, "pbrl-ppl close-loop scene.toml " + 40 * "logs/" + " -o out"),
    }
    for name, html in pages.items():
        (folder / f"{name}.html").write_text(html, encoding="utf-8")
    return {name: folder / f"{name}.html" for name in pages}


@pytest.mark.parametrize(("name", "pictures"), [("loop", 5), ("posterior", 2)])
def test_page_as_a_file(files: dict[str, Path], name: str, pictures: int) -> None:
    html = files[name].read_text(encoding="utf-8")
    stands_alone(html, pictures)
    for address in Page(html).pictures:
        picture = Image.open(BytesIO(base64.b64decode(address.partition(",")[2])))
        low, high = picture.convert("L").getextrema()
        assert low < 100 and high == 255


def test_page_of_many_logs_as_a_file(files: dict[str, Path]) -> None:
    html = files["many"].read_text(encoding="utf-8")
    stands_alone(html, 0, ("cart%20%231/report.html", "told/report.html"))
    for words in (
        "1 adequate, 1 effects added, 1 failed",
        "linear drag[cart], angular drag[cart] and quadratic drag[cart] 12.3 1.01",
        "row 3: x is lost – –",
        "told adequate 1.00 1.00 rows were resampled",
        "logs/ -o out",
    ):
        assert words in Page(html).text, words


def opened(browser: Any, path: Path, width: int, **options: Any) -> tuple[Any, list[str]]:
    """A page, and what it complains of or fetches."""
    context = browser.new_context(viewport={"width": width, "height": 900}, **options)
    page, wrong = context.new_page(), []
    page.on("console", lambda message: wrong.append(message.text))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "request",
        lambda request: (
            wrong.append(request.url[:80])
            if request.url != path.as_uri() and not request.url.startswith("data:")
            else None
        ),
    )
    page.goto(path.as_uri())
    return page, wrong


def until(page: Any, said: str) -> None:
    """Wait until it is so: the page forbids what Playwright waits with."""
    for _ in range(100):
        if page.evaluate(said):
            return
        page.wait_for_timeout(100)
    pytest.fail(f"not in ten seconds: {said}")


#: Contrast of every element's own text with what is behind it (WCAG 2.1), the worst of all.
CONTRAST = """() => {
  const light = (c) => { const [r, g, b] = c.map((v) => v / 255)
    .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  let worst = [99, ""];
  for (const e of document.querySelectorAll("body *")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || e.closest("svg, script, style, noscript, option") || !e.getClientRects().length)
      continue;
    let behind = e, back = parts(getComputedStyle(e).backgroundColor);
    while (back.length === 4 && back[3] === 0 && behind.parentElement) {
      behind = behind.parentElement;
      back = parts(getComputedStyle(behind).backgroundColor);
    }
    const [a, b] = [light(parts(getComputedStyle(e).color)), light(back)].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < worst[0]) worst = [ratio, e.tagName + " " + e.textContent.slice(0, 40)];
  }
  return worst;
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1100])
@pytest.mark.parametrize("name", ["loop", "posterior", "many"])
def test_page_is_readable(
    browser: Any, files: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    page, wrong = opened(browser, files[name], width, color_scheme=scheme)
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    assert wrong == []
    broken = "[...document.images].filter((i) => !i.complete || i.naturalWidth < 300).length"
    assert page.evaluate(broken) == 0
    # nothing sticks out to the side, no cell is cut
    assert page.evaluate("document.documentElement.scrollWidth") == width
    cut = """[...document.querySelectorAll("table, td, tbody th, pre, p, dd, li, img")]
        .filter((e) => e.getBoundingClientRect().right > innerWidth || e.scrollWidth > e.clientWidth + 1 && e.clientWidth)
        .map((e) => e.tagName + " " + e.textContent.slice(0, 40))"""  # noqa: E501
    assert page.evaluate(cut) == []
    ratio, where = page.evaluate(CONTRAST)
    assert ratio >= 4.5, where
    back = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (back == "rgb(255, 255, 255)") == (scheme == "light")
    page.context.close()


def test_motion_plays_and_is_scrubbed_by_keyboard(browser: Any, files: dict[str, Path]) -> None:
    page, wrong = opened(browser, files["loop"], 1100)
    moved = "document.querySelector('#stage-before g.before').getAttribute('transform')"
    clock = "document.getElementById('clock').textContent"
    assert page.evaluate(clock) == "1.20 s of 1.20 s"  # it shows how it ended
    last = page.evaluate(moved)
    page.focus("#play")
    page.keyboard.press("Enter")
    assert page.inner_text("#play") == "Pause"
    page.wait_for_timeout(300)
    midway = page.evaluate(moved)
    assert midway != last
    until(page, "document.querySelector('#play').innerText === 'Play'")
    assert page.evaluate(clock) == "1.20 s of 1.20 s" and page.evaluate(moved) == last
    page.focus("#scrub")
    page.keyboard.press("Home")
    first = page.evaluate(moved)
    assert page.evaluate(clock).startswith("0.00 s")
    assert page.inner_text("#off-before") == "off by 0.00 m and 0.0°"
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    assert page.evaluate(clock).startswith("0.50 s")
    assert page.evaluate(moved) not in (first, last)
    page.select_option("#pick", index=1)
    assert page.evaluate(clock).startswith("0.00 s") and page.evaluate(moved) != first
    assert wrong == []
    page.context.close()


def test_motion_is_a_row_of_stills_where_less_is_wanted(
    browser: Any, files: dict[str, Path]
) -> None:
    page, _ = opened(browser, files["loop"], 1100, reduced_motion="reduce")
    page.click("#play")
    page.wait_for_timeout(350)
    clock = "document.getElementById('clock').textContent"
    assert page.evaluate(clock).startswith("0.00 s")
    until(page, f"!{clock}.startsWith('0.00 s')")
    assert page.inner_text("#play") == "Pause"
    page.context.close()


#: Numbers of points of each curve of a model's picture, measured and predicted.
POINTS = """(model) => ["measured", model].map((kind) =>
  document.querySelector(`#stage-${model} polyline.trail.${kind}`).getAttribute("points")
    .split(" ").filter(Boolean).length)"""


@pytest.mark.parametrize(
    "case",
    [
        "adequate",
        "effects-added",
        "unexplained",
        "unexplained-beside",
        "not-converged",
        "diverging",
    ],
)
def test_page_of_each_verdict_shows_both_curves_and_the_numbers_of_its_json(
    browser: Any, tmp_path: Path, case: str
) -> None:
    loop = every_verdict()[case]
    file = tmp_path / "report.html"
    file.write_text(render(loop), encoding="utf-8")
    told = json.loads(json.dumps(loop.to_dict()))
    page, wrong = opened(browser, file, 1100)
    headline = page.inner_text("h1")
    models = ["before", "after"] if told["added"] else ["before"]
    if told["verdict"] != "not-converged":
        errors = [number(told["error"][model]["normalised_rmse"]) for model in models]
        assert f"held-out error {' → '.join(errors)} times the noise" in headline
    source = "JSON.parse(document.getElementById('motion-data').textContent).motions[0]"
    drawn = page.evaluate(source)
    for i, model in enumerate(models):
        measured, predicted = page.evaluate(POINTS, model)
        end, off = drawn["diverged"][i], page.inner_text(f"#off-{model}")
        assert measured == len(drawn["time"])
        if case == "diverging" and model == "after":
            assert 2 <= predicted < measured
            assert off == f"diverged after {end:.2f} s"
        else:
            assert predicted == measured and end is None
            assert off.startswith("off by ") and not off.startswith("off by 0.00 ")
    if case == "diverging":
        assert "diverged after" in page.inner_text("#pick option:first-child")
        page.focus("#scrub")
        page.keyboard.press("Home")
        assert page.inner_text("#off-after").startswith("off by ")
    assert wrong == []
    page.context.close()
