"""The page in a real browser: no errors, a slider that moves with mouse, touch and keys, nothing wider than a phone.

Needs playwright and a Chromium: its own (`playwright install chromium`), or the one that the environment variable
TORCH_SSAO_CHROMIUM names.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.reports import TINY, corner, quick_fits
from torch_ssao.report import make_report

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

pytestmark = pytest.mark.slow
PHONE, DESK = {"width": 360, "height": 740}, {"width": 1280, "height": 900}


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("page")
    (folder / "peers.json").write_text('[{"name": "a peer with a long name", "ms": 1.5, "validation": {"rmse": 0.2}}]')
    with pytest.MonkeyPatch.context() as patch:
        quick_fits(patch)
        options = {"technique": ("statvo", "hbao"), "options": {"layers": (1, 2), "slices": 2, "steps": 2}}
        made = make_report(corner(), folder / "out", **TINY | options, peers=folder / "peers.json", target_rmse=0.3)
    return (made.out / "report.html").resolve().as_uri()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = os.environ.get("TORCH_SSAO_CHROMIUM")
    with sync_api.sync_playwright() as driver:
        if path is None and not Path(driver.chromium.executable_path).exists():
            pytest.skip("no Chromium: run `playwright install chromium`, or set TORCH_SSAO_CHROMIUM to one")
        chromium = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def complaints() -> list[str]:
    return []


@pytest.fixture(params=[DESK, PHONE], ids=["desk", "phone"])
def page(request: pytest.FixtureRequest, browser: Any, address: str, complaints: list[str]) -> Iterator[Any]:
    """The page, opened; `complaints` collects what the browser has to say about it."""
    context = browser.new_context(viewport=request.param, has_touch=request.param is PHONE)
    opened = context.new_page()
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("console", lambda message: complaints.append(message.text))
    opened.on(
        "request", lambda sent: complaints.append(sent.url) if not sent.url.startswith(("file:", "data:")) else None
    )
    opened.goto(address)
    yield opened
    context.close()


def cuts(page: Any) -> list[int]:
    return [int(handle.get_attribute("aria-valuenow")) for handle in page.get_by_role("slider").all()]


def box_of(page: Any) -> dict[str, float]:
    stage = page.locator(".stage")
    stage.scroll_into_view_if_needed()
    return stage.bounding_box()


def test_nothing_goes_wrong_and_nothing_is_loaded(page: Any, complaints: list[str]) -> None:
    page.get_by_label("model").select_option(index=1)
    page.locator("summary").click()
    broken = page.evaluate("[...document.images].filter(image => !image.complete || !image.naturalWidth).length")
    assert broken == 0
    assert complaints == []


def test_the_page_is_no_wider_than_the_screen(page: Any) -> None:
    page.locator("summary").click()
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_the_slider_moves_with_the_mouse(page: Any) -> None:
    assert cuts(page) == [33, 67]
    box = box_of(page)
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.33 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.2 * box["width"], middle)
    assert abs(cuts(page)[0] - 20) <= 1
    page.mouse.move(box["x"] + 0.8 * box["width"], middle)  # takes the other one along
    assert cuts(page)[0] == cuts(page)[1]
    assert abs(cuts(page)[0] - 80) <= 1
    page.mouse.up()
    page.mouse.move(box["x"] + 0.5 * box["width"], middle)
    assert abs(cuts(page)[0] - 80) <= 1  # let go


def test_the_slider_moves_with_the_keys(page: Any) -> None:
    left, right = page.get_by_role("slider").all()
    left.focus()
    for key, wanted in {"ArrowRight": 34, "PageUp": 44, "ArrowLeft": 43, "PageDown": 33, "Home": 0}.items():
        page.keyboard.press(key)
        assert cuts(page) == [wanted, 67], key
    page.keyboard.press("Tab")
    assert right.evaluate("element => element === document.activeElement")
    page.keyboard.press("End")
    assert cuts(page) == [0, 100]
    page.keyboard.press("ArrowRight")
    assert cuts(page) == [0, 100]


def test_the_slider_moves_with_a_finger(browser: Any, page: Any) -> None:
    if page.viewport_size != PHONE:
        pytest.skip("a desk has no fingers")
    box = box_of(page)
    page.touchscreen.tap(box["x"] + 0.1 * box["width"], box["y"] + 10)
    assert abs(cuts(page)[0] - 10) <= 1
    fingers = page.context.new_cdp_session(page)
    spot = {"x": box["x"] + 0.1 * box["width"], "y": box["y"] + 20}
    fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [spot]})
    for part in (0.2, 0.3, 0.4, 0.5):
        there = {"x": box["x"] + part * box["width"], "y": spot["y"]}
        fingers.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [there]})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.wait_for_timeout(100)  # moves are handed over once a frame
    assert abs(cuts(page)[0] - 50) <= 1


def test_each_part_shows_its_picture(page: Any) -> None:
    """What is on the screen at the left, in the middle and at the right is the picture that the list holds."""
    for index, name in enumerate(("statvo_1", "statvo_2", "hbao_2x2")):
        page.get_by_label("model").select_option(index=index)
        for part in ("untuned", "fitted"):
            assert page.locator(f".layer.{part} img").get_attribute("src") == source(page, f"{name}_{part}")
            assert page.locator(f".error.{part} img").get_attribute("src") == source(page, f"{name}_{part}_error")
        assert "untuned" in page.locator(".note").inner_text()
    assert page.locator(".layer.reference img").get_attribute("src") == source(page, "reference")
    box = box_of(page)
    for part, kind in ((0.1, "untuned"), (0.5, "fitted"), (0.9, "reference")):
        spot = (box["x"] + part * box["width"], box["y"] + 0.25 * box["height"])
        there = page.evaluate(
            "([x, y]) => document.elementsFromPoint(x, y).find(e => e.tagName === 'IMG').parentElement.className", spot
        )
        assert there == f"layer {kind}"


def source(page: Any, name: str) -> str:
    return page.locator(f"#picture-{name}").get_attribute("src")


def test_the_chosen_model_is_shown_first(page: Any) -> None:
    chosen = page.locator("p.choice strong").inner_text()
    assert chosen.startswith("Chosen: ")
    shown = page.get_by_label("model").evaluate("list => list.selectedOptions[0].textContent")
    assert shown.split(" ")[0] in chosen


def test_without_script_every_picture_is_there(browser: Any, address: str) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(address)
    assert not page.locator("#compare").is_visible()
    page.locator("summary").click()
    assert page.locator("#picture-statvo_1_fitted").is_visible()
    context.close()
