"""Photographs of pages, and the flaws that a person would see in them: for tests of pages in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.browser import Browser

CONTRAST = """
(() => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const back = (one) => { for (; one; one = one.parentElement) {
    const found = parts(getComputedStyle(one).backgroundColor); if (found.length < 4 || found[3] > 0) return found; }
    return [255, 255, 255]; };
  const texts = [...document.querySelectorAll("body *")].filter((one) => one.checkVisibility() && one.tagName != "SCRIPT" &&
    [...one.childNodes].some((child) => child.nodeType == 3 && child.textContent.trim()));
  const ratios = texts.map((one) => {
    const [a, b] = [light(parts(getComputedStyle(one).color)), light(back(one))].sort((x, y) => y - x);
    return [(a + 0.05) / (b + 0.05), one.tagName + " " + one.className + " " + one.textContent.slice(0, 40)]; });
  return ratios.sort((x, y) => x[0] - y[0])[0];
})()
"""
"""The smallest ratio of contrast of any text (WCAG 2.2), and that text."""
BOXES = """
(() => {
  const within = (box, one) => {  // the part of a box that no scrolling ancestor hides
    const sticky = one.closest("thead");
    for (let up = one.parentElement; up && up !== document.body; up = up.parentElement) {
      if (getComputedStyle(up).overflow == "visible") continue;
      const r = up.getBoundingClientRect();
      const head = sticky || !up.querySelector("thead th") ? 0 : up.querySelector("thead").getBoundingClientRect().height;
      box = { left: Math.max(box.left, r.left), right: Math.min(box.right, r.right),
              top: Math.max(box.top, r.top + head), bottom: Math.min(box.bottom, r.bottom) };
    }
    return box;
  };
  const drawn = "img, video, canvas, button, input, select, textarea, iframe";
  const found = [];
  const add = (one, rect) => {
    const { left, right, top, bottom } = within(rect, one);
    if (right - left > 1 && bottom - top > 1) found.push({
      tag: one.tagName, text: (one.innerText || one.alt || "").slice(0, 30),
      box: [left + scrollX, top + scrollY, right + scrollX, bottom + scrollY] });
  };
  for (const one of document.querySelectorAll("body *")) {
    if (!one.checkVisibility() || one.closest(".heard, .skip, option, script")) continue;
    if (one.matches(drawn)) { add(one, one.getBoundingClientRect()); continue; }
    if (one.closest("button")) continue;
    for (const child of one.childNodes) {
      if (child.nodeType != 3 || !child.textContent.trim()) continue;
      const range = document.createRange();
      range.selectNodeContents(child);
      for (const rect of range.getClientRects()) add(one, rect);
    }
  }
  return found;
})()
"""
"""The boxes in which something is drawn or written: left, top, right and bottom in pixels of the page, without hidden parts."""
EMPTY_VIDEOS = """
(async () => {
  const empty = [];
  for (const video of document.querySelectorAll("video")) {
    if (!video.checkVisibility()) continue;
    video.scrollIntoView();
    const drawn = new Promise(done => video.requestVideoFrameCallback(done));
    video.currentTime = video.currentTime ? 0 : video.duration / 2;
    await drawn;
    const context = new OffscreenCanvas(video.videoWidth, video.videoHeight).getContext("2d");
    context.drawImage(video, 0, 0);
    const { data } = context.getImageData(0, 0, video.videoWidth, video.videoHeight);
    if (new Set(new Uint32Array(data.buffer)).size < 10) empty.push(`the video ${video.ariaLabel} is empty`);
  }
  scrollTo(0, 0);
  return empty;
})()
"""
"""The videos that have no frame with several colors. A photograph lacks those outside the window."""
SLACK = 3.0
"""The overlap in pixels that nobody sees: boxes of lines of text are higher than their letters."""
FIGURES = ("IMG", "CANVAS")
AXE = "axe.run().then(found => found.violations.map(one => `${one.id}: ${one.help}: ${one.nodes[0].html}`))"
"""The violations of the rules of axe-core, with the first part of the page that each is about."""
VALIDATORS = Path(__file__).parents[2] / ".venv-validators"


def unfold(browser: Browser) -> None:
    """Open all parts of the page that can be unfolded."""
    browser.run("document.querySelectorAll('details').forEach(one => one.open = true)")
    browser.settle()


def flaws(browser: Browser, file: Path, *, dark: bool) -> list[str]:
    """Photograph the page in the browser, write the picture as PNG, and return what is wrong with it."""
    videos = browser.run(EMPTY_VIDEOS)
    browser.picture(file)
    with Image.open(file) as image:
        pixels = np.asarray(image.convert("L")).astype(int)
    found = browser.run(BOXES)
    assert len(found) > 20
    return [
        *videos,
        *_sideways(browser, found),
        *_overlaps(found),
        *_blank(found, pixels),
        *_back(pixels, dark),
        *_faint(browser),
        *_inaccessible(browser),
    ]


def _inaccessible(browser: Browser) -> list[str]:
    """Return what axe-core finds. Without it, the test is skipped."""
    script = next(VALIDATORS.glob("lib/python3*/site-packages/axe_playwright_python/axe.min.js"), None)
    if script is None:
        pytest.skip("needs axe-core: `make .venv-validators/installed`")
    browser.run(f"{script.read_text('utf-8')}; 0")
    violations: list[str] = browser.run(AXE)
    return violations


def _sideways(browser: Browser, found: list[dict[str, Any]]) -> list[str]:
    wide, width = browser.run("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    left = [f"{one['tag']} {one['text']!r} leaves the page" for one in found if one["box"][0] < 0 or one["box"][2] > width + 1]
    return [*left, *([f"the page is {wide} pixels wide, its window {width}"] if wide > width else [])]


def _overlaps(found: list[dict[str, Any]]) -> list[str]:
    """Return the pairs of boxes that are partly over each other. Buttons over a video belong to the browser."""
    boxes = np.array([one["box"] for one in found])
    left, top, right, bottom = (boxes[:, k] for k in range(4))
    across = np.minimum(right[:, None], right) - np.maximum(left[:, None], left)
    down = np.minimum(bottom[:, None], bottom) - np.maximum(top[:, None], top)
    pairs = np.argwhere(np.triu((across > SLACK) & (down > SLACK), 1))
    return [f"{_named(found[i])} is over {_named(found[k])}" for i, k in pairs]


def _named(one: dict[str, Any]) -> str:
    return f"{one['tag']} {one['text']!r} at {[round(value) for value in one['box']]}"


def _blank(found: list[dict[str, Any]], pixels: np.ndarray) -> list[str]:
    """Return the figures in whose box nothing is drawn: they have one color."""
    shown = []
    for one in found:
        left, top, right, bottom = (round(value) for value in one["box"])
        if one["tag"] in FIGURES and pixels[top + 2 : bottom - 2, left + 2 : right - 2].std() < 2:
            shown.append(f"{_named(one)} is empty")
    return shown


def _back(pixels: np.ndarray, dark: bool) -> list[str]:
    """Check the left edge of the whole page: nothing but the background is there."""
    edge = pixels[:, :4]
    return [] if (edge.max() < 60 if dark else edge.min() > 200) else [f"the background is {edge.min()} to {edge.max()} of 255"]


def _faint(browser: Browser) -> list[str]:
    ratio, text = browser.run(CONTRAST)
    return [] if ratio >= 4.5 else [f"the contrast of {text} is {ratio:.2f}"]


def unnamed(browser: Browser, frame: str = "") -> list[str]:
    """Return the roles of the elements of the accessibility tree that a reader reaches or is told of, but that have no name.

    `frame`: the id of an element `iframe` whose page is meant instead.
    """
    more = {"frameId": _frame(browser)} if frame else {}
    nodes = [one for one in browser.call("Accessibility.getFullAXTree", **more)["nodes"] if not one["ignored"]]
    assert len(nodes) > 50
    return [one["role"]["value"] for one in nodes if _needs_name(one) and not one["name"].get("value", "").strip()]


ROLES = {"option", "image", "Video", "region", "navigation", "Iframe", "listbox", "heading", "link", "button"}


def _needs_name(node: dict[str, Any]) -> bool:
    reached = any(one["name"] == "focusable" and one["value"].get("value") for one in node.get("properties", []))
    return node["role"]["value"] in ROLES or (reached and node["role"]["value"] != "main")


def _frame(browser: Browser) -> str:
    children = browser.call("Page.getFrameTree")["frameTree"]["childFrames"]
    return str(next(one["frame"]["id"] for one in children))
