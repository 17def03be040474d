"""The report in a real Chromium, headless: the slider, the console, the network, paper, reading."""

from __future__ import annotations

import base64
import json
from io import BytesIO
from itertools import pairwise

import pypdf
import pytest
from axe_core_python.selenium import Axe
from browser import start_chromium, wide
from report_site import reports_of_whole_run
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

WAIT_S = 300  # for what hangs
PAPER_PX = 688  # 182 mm, between the margins of A4
LABELS = [
    "Whole time", "17:06:40 to 17:07:00", "17:07:00 to 17:07:20", "17:07:20 to 17:07:40",
]  # fmt: skip


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    browser = start_chromium(tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.quit()


@pytest.fixture(scope="module")
def report(once):
    return reports_of_whole_run(once)["en"].outputs[0]


@pytest.fixture
def page(chromium, report):
    """Open the page afresh, with nothing left in the logs."""
    wide(chromium, 1280)
    for kind in ("browser", "performance"):
        chromium.get_log(kind)
    chromium.get(report.as_uri())
    # what a test clicks is in the window, and nothing moves any more
    chromium.execute_script(
        "document.documentElement.style.scrollBehavior = 'auto';"
        "document.getElementById('map').scrollIntoView()"
    )
    return chromium


def by_id(page, name):
    return page.find_element(By.ID, name)


def shown(page):
    """Return the source of the large picture, and all that says what it shows."""
    words = {by_id(page, "shown").text, by_id(page, "label").text}
    words.add(by_id(page, "slider").get_attribute("aria-valuetext"))
    assert len(words) == 1, f"the page disagrees with itself: {words}"
    (label,) = words
    picture = by_id(page, "picture")
    assert label in picture.get_attribute("alt")
    return picture.get_attribute("src"), label


def test_the_slider_by_keyboard(page):
    slider = by_id(page, "slider")
    assert slider.is_displayed()
    seen = [shown(page)]
    for _ in LABELS[1:]:
        slider.send_keys(Keys.ARROW_RIGHT)
        seen.append(shown(page))
    assert [label for _, label in seen] == LABELS
    assert len({src for src, _ in seen}) == len(LABELS)
    slider.send_keys(Keys.HOME)
    assert shown(page) == seen[0]
    slider.send_keys(Keys.END)
    assert shown(page) == seen[-1]


def test_the_slider_reaches_the_keyboard_in_order(page):
    by_id(page, "content")
    reached = []
    for _ in range(20):
        page.switch_to.active_element.send_keys(Keys.TAB)
        reached.append(page.switch_to.active_element.get_attribute("id"))
    # "Earlier" is off at the begin
    found = [name for name in reached if name in {"slider", "play", "later", "reset"}]
    assert found == ["slider", "play", "later", "reset"]


def test_the_buttons(page):
    earlier, later = by_id(page, "earlier"), by_id(page, "later")
    assert not earlier.is_enabled()
    later.click()
    later.click()
    assert shown(page)[1] == LABELS[2]
    earlier.click()
    assert shown(page)[1] == LABELS[1]
    by_id(page, "reset").click()
    assert shown(page)[1] == LABELS[0]


def test_play_goes_on_and_stops(page):
    play = by_id(page, "play")
    play.click()
    assert play.text == "Pause"
    assert play.get_attribute("aria-pressed") == "true"
    WebDriverWait(page, WAIT_S, 0.05).until(lambda each: by_id(each, "shown").text == LABELS[3])
    WebDriverWait(page, WAIT_S, 0.05).until(lambda each: by_id(each, "shown").text == LABELS[1])
    play.click()
    assert play.text == "Play"
    before = shown(page)
    page.execute_async_script("setTimeout(arguments[0], 1200)")
    assert shown(page) == before


def test_no_request_and_no_complaint(page, report):
    slider = by_id(page, "slider")
    for _ in LABELS:
        slider.send_keys(Keys.ARROW_RIGHT)
    by_id(page, "play").click()
    page.execute_script("window.scrollTo(0, document.body.scrollHeight)")
    pictures = "[...document.images].every(each => each.complete && each.naturalWidth > 100)"
    page.execute_script("for (const each of document.images) each.loading = 'eager'")
    WebDriverWait(page, WAIT_S).until(lambda each: each.execute_script(f"return {pictures}"))
    assert page.get_log("browser") == []
    messages = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    asked = [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
    assert [url for url in asked if not url.startswith("data:")] == [report.as_uri()]
    assert not any(message["method"].startswith("Network.webSocket") for message in messages)


def test_the_policy_holds_even_if_something_got_in(page):
    page.execute_script(
        "const image = new Image(); image.src = 'https://example.org/a.png';"
        "document.body.append(image);"
        "const script = document.createElement('script'); script.textContent = 'window.evil = 1';"
        "document.body.append(script);"
    )
    assert page.execute_script("return window.evil === undefined")
    refused = [entry["message"] for entry in page.get_log("browser")]
    assert len(refused) == 2
    assert all("Content Security Policy" in message for message in refused)


def test_accessible_by_the_rules_of_axe(page):
    wide(page, 400)
    found = Axe().run(page)
    wrong = [(each["id"], each["help"], len(each["nodes"])) for each in found["violations"]]
    assert wrong == []
    assert len(found["passes"]) > 30


def test_names_for_a_screen_reader(page):
    tree = page.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]

    def named(role):
        return [
            node.get("name", {}).get("value", "")
            for node in tree
            if node.get("role", {}).get("value") == role and not node["ignored"]
        ]

    assert named("slider") == ["Time of the map"]
    assert all(named("image"))
    assert sum("Map of radar hits, " in name for name in named("image")) == 1  # others are folded
    assert all(named("table"))
    assert {"Contents"} <= set(named("navigation"))
    assert named("banner") == [""] == named("main")


def test_all_words_can_be_read_on_a_phone(page):
    """None is under 10 pixels, charts are as wide as the page, pictures those with large words."""
    wide(page, 390)
    small = page.execute_script(
        "const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);"
        "const found = []; let each;"
        "while ((each = walker.nextNode())) {"
        "  const holder = each.parentElement;"
        "  if (!each.data.trim() || holder.closest('script')) continue;"
        "  if (parseFloat(getComputedStyle(holder).fontSize) < 10) found.push(each.data);"
        "} return found"
    )
    assert small == []
    widths = page.execute_script(
        "return [...document.querySelectorAll('.strip > svg')]"
        ".map(each => each.getBoundingClientRect().width)"
    )
    assert len(widths) > 2
    assert min(widths) > 250
    labels = page.execute_script(
        "return [...document.querySelectorAll('.ends text')]"
        ".map(each => each.getBoundingClientRect()).filter(each => each.width)"
        ".map(each => [each.left, each.right])"
    )
    assert labels
    assert all(one[1] < other[0] for one, other in pairwise(labels))
    pictures = "document.querySelectorAll('picture > source')"
    shown = (
        f"return [...{pictures}].map(each => each.parentElement.querySelector('img'))"
        ".map(each => each.currentSrc === each.src)"
    )
    page.execute_script("for (const each of document.images) each.loading = 'eager'")
    WebDriverWait(page, WAIT_S).until(lambda each: not any(each.execute_script(shown)))
    assert len(page.execute_script(shown)) >= 3  # the map's words, the lanes, what sensors see
    wide(page, 1280)
    WebDriverWait(page, WAIT_S).until(lambda each: all(each.execute_script(shown)))


@pytest.mark.parametrize("width", [800, 390])
def test_nothing_is_wider_than_the_window(page, width):
    wide(page, width)
    assert page.execute_script("return document.documentElement.scrollWidth") <= width


def test_without_script(chromium, report):
    chromium.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        chromium.get(report.as_uri())
        assert not by_id(chromium, "controls").is_displayed()
        assert by_id(chromium, "picture").is_displayed()
        chromium.find_element(By.CSS_SELECTOR, ".times summary").send_keys(Keys.ENTER)
        frames = chromium.find_elements(By.CSS_SELECTOR, ".frames figure")
        assert [each.text.splitlines()[0] for each in frames] == LABELS[1:]
    finally:
        chromium.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})


def test_on_paper(page, report):
    by_id(page, "later").click()
    sheet = page.execute_cdp_cmd(
        "Page.printToPDF", {"printBackground": True, "preferCSSPageSize": True}
    )
    paper = pypdf.PdfReader(BytesIO(base64.b64decode(sheet["data"])))
    text = "\n".join(each.extract_text() for each in paper.pages)
    for words in (
        "Kreuzung Münchner Straße", LABELS[0], "What this rests on", "The lanes over time",
        "What the words mean", "not observed", "Verdict",
    ):  # fmt: skip
        assert words in text, words
    assert "Arrow keys" not in text
    assert len(paper.pages) < 12
    assert shown(page)[1] == LABELS[1]  # what was shown before is shown again


def test_no_table_is_cut_on_paper(page):
    wide(page, PAPER_PX)
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        edges = page.execute_script(
            "return [...document.querySelectorAll('table, figure, dl')]"
            ".map(each => each.getBoundingClientRect().right)"
        )
        assert len(edges) > 8
        assert max(edges) <= PAPER_PX + 0.5
        cells = "return [...document.querySelectorAll('td')].map(e => getComputedStyle(e).display)"
        assert set(page.execute_script(cells)) == {"table-cell"}  # no cards, as on a phone
        assert not by_id(page, "controls").is_displayed()
    finally:
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
