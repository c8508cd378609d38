"""The explorer: its page in a browser, the slider moved, numbers equal to the library's."""

import re
import shutil
from dataclasses import replace
from functools import cache

import pytest

from formulations import MCMP, S3P
from formulations.command_line import main
from refusing import refused
from small_models import model_of
from ssp_lp import end_probability, evaluate, solve, trace_frontier
from ssp_lp.analysis.evaluation import pair_visits
from ssp_lp.plotting import Explorer, explore

SKID = model_of(
    {
        "a": {
            "fast": [(0.9, "g", 1.0), (0.1, "skid", 1.0)],
            "mid": [(0.98, "g", 4.0), (0.02, "wreck", 4.0)],
            "slow": [(1.0, "g", 10.0)],
        },
        "skid": {"slide": [(0.5, "wreck", 0.0), (0.5, "ash", 0.0)]},
    },
    labels={"crash": ["wreck"], "fire": ["ash"]},
)
HELD = {"crash": end_probability("crash") <= 0.1, "fire": end_probability("fire") <= 0.03}
FIELD = model_of(
    {
        (0, 1): {
            "east": [(0.9, (1, 1), 1.0), (0.1, (1, 0), 1.0)],
            "south": [(0.5, (0, 0), 1.0), (0.5, (0, 1), 1.0)],
        },
        (1, 1): {"east": [(1.0, (2, 1), 1.0)]},
        (2, 1): {"south": [(1.0, (2, 0), 1.0)]},
        (0, 0): {"east": [(1.0, (2, 0), 7.0)]},
        (1, 0): {},
    },
    (2, 0),
    labels={"pit": [(1, 0)]},
)
PROBLEMS = {
    "crash": (MCMP(SKID, "a", 0.1, constraints=HELD), "crash"),
    "given success": (S3P(FIELD, (0, 1), 0.05), "failure"),
    "field": (MCMP(FIELD, (0, 1), 0.05), "failure"),
}


@cache
def traced(case):
    return trace_frontier(*PROBLEMS[case])


@pytest.fixture(scope="module")
def browser():
    """Chromium without a screen."""
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("there is no chromium with its chromedriver")
    options, service = webdriver.ChromeOptions(), webdriver.ChromeService(driver)
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    found = webdriver.Chrome(options=options, service=service)
    yield found
    found.quit()


@pytest.fixture
def opened(browser):
    """Opens a page and waits until it is drawn."""
    from selenium.webdriver.support.ui import WebDriverWait

    def open_page(path):
        browser.get(path.as_uri())
        ready = "return document.body.dataset.ready === 'yes'"
        WebDriverWait(browser, 60).until(lambda page: page.execute_script(ready))
        return browser

    return open_page


def numbers(page):
    """What the table on the page says, with all digits."""
    told = (
        "[...document.querySelectorAll('#numbers td')].map((c) => [c.dataset.key, c.dataset.value])"
    )
    return {key: float(value) for key, value in page.execute_script(f"return {told}") if value}


def typed(page, bound):
    """The numbers once a bound has been typed in."""
    page.execute_script(
        "const box = document.getElementById('bound'); box.value = arguments[0];"
        "box.dispatchEvent(new Event('change'))",
        bound,
    )
    return numbers(page)


@pytest.mark.parametrize("case", PROBLEMS)
def test_numbers_on_the_page_are_the_library_s(case, opened, tmp_path):
    problem, frontier = PROBLEMS[case][0], traced(case)
    assert isinstance(explore(frontier, tmp_path / "page.html", seed=3), Explorer)
    assert (tmp_path / "page.html").stat().st_size < 3_000_000
    page = opened(tmp_path / "page.html")
    first, last = float(frontier.spent[0]), float(frontier.spent[-1])
    bounds = [first, 0.3 * first + 0.7 * last, 0.9 * first + 0.1 * last, *frontier.spent.tolist()]
    for bound in bounds:
        told, found = typed(page, bound), evaluate(frontier.policy_at(bound), problem)
        assert told["objective"] == pytest.approx(frontier.objective_at(bound), rel=1e-12)
        assert told["failing"] == pytest.approx(found.failure_probability, abs=1e-12)
        assert told["paid"] == pytest.approx(found.conditional_cost, rel=1e-12)
        for name, value in found.secondary_costs.items():
            assert told[name] == pytest.approx(value, abs=1e-12)
        drawn = page.execute_script("return shown.ends")
        ends = {name.replace("_", " "): share for name, share in found.ends.items()}
        for name, share in zip(drawn["end"], drawn["share"], strict=True):
            assert share == pytest.approx(ends.get(name, 0.0), abs=1e-12)
    severe = [entry for entry in page.get_log("browser") if entry["level"] == "SEVERE"]
    assert severe == []


def test_the_slider_moves_everything(opened, tmp_path):
    from selenium.webdriver.common.keys import Keys

    problem, frontier = PROBLEMS["field"][0], traced("field")
    explore(frontier, tmp_path / "page.html")
    page = opened(tmp_path / "page.html")
    before, slider = numbers(page), page.find_element("id", "budget")
    slider.send_keys(Keys.HOME)
    assert numbers(page)["objective"] == pytest.approx(float(frontier.objective[0]))
    slider.send_keys(Keys.ARROW_RIGHT * 5)
    bound = float(page.find_element("id", "bound").get_attribute("value"))
    low, high = frontier.region
    assert bound == pytest.approx(low + 0.005 * (high - low))
    told = numbers(page)
    assert told["objective"] == pytest.approx(frontier.objective_at(bound), rel=1e-9)
    assert told["objective"] != before["objective"]
    pairs, gave_up = pair_visits(frontier.policy_at(bound), problem)
    drawn = page.execute_script("return [shown.visits, shown.runs, shown.here, shown.law]")
    assert sum(drawn[0]) == pytest.approx(pairs.sum() + gave_up.sum(), rel=1e-5)
    assert len(drawn[1]) == 20
    assert drawn[2]["x"] == pytest.approx(bound)
    assert sum(drawn[3]["share"]) == pytest.approx(1.0, abs=0.011)
    page.find_element("id", "whole").click()
    typed(page, 1.0)
    assert numbers(page)["objective"] == pytest.approx(frontier.objective_at(1.0))


def test_the_price_is_the_failure_price(opened, tmp_path):
    for case in ("given success", "field"):
        explore(traced(case), tmp_path / "page.html", episodes=0)
        told = typed(opened(tmp_path / "page.html"), 0.03)  # no turning point
        price = solve(replace(PROBLEMS[case][0], failure_budget=0.03)).failure_price
        assert told["price"] == pytest.approx(price, rel=1e-7)


def test_a_page_stands_alone_and_in_a_notebook():
    problem = MCMP(SKID, "a", 0.1, constraints={"</script>": end_probability("crash") <= 0.1})
    page = explore(trace_frontier(problem, "</script>"))
    head, told = page.page.rsplit("<body>", 1)
    assert "<h1>MCMP: least cost against bound on &lt;/script&gt;</h1>" in told
    assert "http://" not in told
    assert "https://" not in told
    assert re.search(r"<(script|link|img)[^>]* (src|href)=", head + told) is None
    assert page._repr_html_().startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert "bytes of HTML" in repr(page)


def test_what_cannot_be_explored_is_refused(monkeypatch):
    frontier = traced("field")
    refused("takes a frontier", explore, solve(PROBLEMS["field"][0]))
    monkeypatch.setattr("ssp_lp.plotting.explorer.LARGEST", 1_000)
    refused("point_limit", explore, frontier)


def test_a_page_from_the_command_line(tmp_path, capsys):
    pytest.importorskip("gymnasium")
    out = tmp_path / "lake.html"
    asked = ["explore", "gym:FrozenLake-v1", "--horizon", "none", "--point-limit", "5"]
    assert main([*asked, "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith("Frontier(5 points, failure 0")
    assert '"runs"' in out.read_text(encoding="utf-8")


DRAWN = "return shown[arguments[0]][arguments[1]]"


def test_arrows_of_a_graph_are_named_by_their_actions(opened, tmp_path):
    explore(traced("crash"), tmp_path / "page.html")
    page = opened(tmp_path / "page.html")
    typed(page, 0.05)
    names = page.execute_script(DRAWN, "arrows", "action")
    seen = page.execute_script(DRAWN, "arrows", "seen")
    assert set(names) == {"fast", "mid", "slow", "slide"}
    policy = traced("crash").policy_at(0.05)
    taken = {row.action for member in policy.policies for row in member.table()}
    assert {name for name, is_seen in zip(names, seen, strict=True) if is_seen} <= taken


TIPS = """
const tips = document.querySelectorAll("#plane line.arrow title");
return [...tips].map((tip) => tip.textContent);
"""


def test_an_arrow_that_is_seen_says_its_action(opened, tmp_path):
    """Each action's tooltip has how often it is taken; arrows that are not seen are not drawn."""
    explore(traced("field"), tmp_path / "page.html")
    page = opened(tmp_path / "page.html")
    typed(page, 0.0)
    names, told, seen = (
        page.execute_script(DRAWN, "arrows", n) for n in ("action", "told", "seen")
    )
    assert set(seen) == {False, True}
    assert page.execute_script(TIPS) == [
        f"action: {name}, expected times: {times}"
        for name, times, is_seen in zip(names, told, seen, strict=True)
        if is_seen
    ]


def test_words_of_a_model_are_text_on_the_page(opened, tmp_path):
    """Names of states, actions and labels are written as they are, whatever signs are in them."""
    sly = '<b title="&">'
    model = model_of({sly: {sly: [(0.9, "g", 1.0), (0.1, "d", 1.0)], "-": [(1.0, "g", 3.0)]}})
    explore(trace_frontier(MCMP(model, sly, 0.05)), tmp_path / "page.html")
    page = opened(tmp_path / "page.html")
    written = "return [...document.querySelectorAll('#plane text')].map((t) => t.textContent)"
    assert sly in page.execute_script(written)
    assert page.execute_script("return document.querySelectorAll('#plane b').length") == 0


@pytest.mark.parametrize("case", PROBLEMS)
def test_a_page_shows_four_digits_and_costs_as_far_as_they_go(case, opened, tmp_path):
    frontier = traced(case)
    explore(frontier, tmp_path / "page.html")
    page = opened(tmp_path / "page.html")
    for bound in (float(frontier.spent[0]), 0.03, float(frontier.spent[-1])):
        typed(page, bound)
        shown = page.find_element("id", "numbers").text
        told = page.execute_script(DRAWN, "ends", "told")
        for number in re.findall(r"\d+\.\d+(?:e-?\d+)?", " ".join([shown, *told])):
            digits = number.partition("e")[0].replace(".", "").lstrip("0")
            assert len(digits) <= 4
        slider = page.find_element("id", "budget")
        assert slider.get_attribute("aria-label").startswith(f"Bound on {frontier.over}")
        assert f"{frontier.over} at most" in slider.get_attribute("aria-valuetext")
        right, share, end = (
            page.execute_script(DRAWN, "law", n) for n in ("right", "share", "end")
        )
        after = [s for r, s in zip(right, share, strict=True) if r > end + 1e-9]
        assert max(after, default=0.0) <= 0.002 * max(share)
        assert share[right.index(end)] > 0.0
