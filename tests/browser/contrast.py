"""The contrast of every text of a page to what is really behind it.

Measured as WCAG 2.2 does (relative luminance): 4.5 to 1 is what ordinary text must have.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

ENOUGH: Final = 4.5

# Colours are what a canvas makes of what the browser has computed; shapes are asked whether the text's box is in them.
_MEASURE: Final = """within => {
    const canvas = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
    const rgba = (colour) => {
        canvas.clearRect(0, 0, 1, 1);
        canvas.fillStyle = colour;
        canvas.fillRect(0, 0, 1, 1);
        const [r, g, b, a] = canvas.getImageData(0, 0, 1, 1).data;
        return [r, g, b, a / 255];
    };
    const over = (top, ground, opacity = 1) => {
        const alpha = top[3] * opacity;
        return [0, 1, 2].map((i) => top[i] * alpha + ground[i] * (1 - alpha)).concat(1);
    };
    const luminance = (colour) => {
        const [r, g, b] = colour.map((part) => part / 255)
            .map((part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const ratio = (one, other) => {
        const [dark, light] = [luminance(one), luminance(other)].sort((a, b) => a - b);
        return (light + 0.05) / (dark + 0.05);
    };
    const chain = (element) => element ? [...chain(element.parentElement), element] : [];
    const opacity = (element, end = null) => chain(element).slice(end ? chain(end).length : 0)
        .reduce((all, each) => all * getComputedStyle(each).opacity, 1);
    const ground = (element) => chain(element).reduce(
        (below, each) => over(rgba(getComputedStyle(each).backgroundColor), below), [255, 255, 255, 1]);
    const covers = (shape, x, y) => {
        const style = getComputedStyle(shape);
        if (style.fill === 'none' || style.visibility === 'hidden' || style.display === 'none') return false;
        const point = new DOMPoint(x, y).matrixTransform(shape.getScreenCTM().inverse());
        return shape.isPointInFill(point);
    };
    const found = [];
    for (const text of document.querySelectorAll(`${within} svg text`)) {
        const svg = text.closest('svg'), box = text.getBoundingClientRect();
        if (!box.width) continue;
        const shapes = [...svg.querySelectorAll('rect,polygon,ellipse,circle,path')].filter(
            (shape) => shape.compareDocumentPosition(text) & Node.DOCUMENT_POSITION_FOLLOWING);
        const y = box.top + box.height / 2;
        const worst = Math.min(...[box.left + 1, box.left + box.width / 2, box.right - 1].map((x) => {
            const behind = shapes.filter((shape) => covers(shape, x, y)).reduce(
                (below, shape) => over(rgba(getComputedStyle(shape).fill), below, opacity(shape, svg)
                    * getComputedStyle(shape).fillOpacity), ground(svg));
            return ratio(over(rgba(getComputedStyle(text).fill), behind, opacity(text)), behind);
        }));
        found.push([text.textContent, worst]);
    }
    const walker = document.createTreeWalker(document.querySelector(within), NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
        const element = walker.currentNode.parentElement;
        if (!walker.currentNode.data.trim() || element.closest('svg,script,style') || !element.checkVisibility()) continue;
        if (chain(element).some((each) => getComputedStyle(each).clipPath !== 'none')) continue;
        const behind = ground(element);
        found.push([walker.currentNode.data.trim(), ratio(over(rgba(getComputedStyle(element).color), behind,
            opacity(element)), behind)]);
    }
    return found;
}"""


@dataclass(frozen=True)
class Reading:
    """A text and its contrast to what is behind it."""

    text: str
    ratio: float


def readings(page: Any, within: str) -> list[Reading]:
    """Return the contrast of every visible text within the elements that a selector finds; hidden tables are not seen."""
    return [Reading(text, ratio) for text, ratio in page.evaluate(_MEASURE, within)]


def schemes(page: Any) -> Iterator[str]:
    """Show a page that follows the system's colours in light ones, then in dark ones."""
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        yield scheme


def unreadable(page: Any, within: str = ".epypes-sheet") -> list[Reading]:
    """Return the texts whose contrast is not enough; AssertionError if there is no text at all."""
    found = readings(page, within)
    assert found, "nothing was measured"
    return [reading for reading in found if reading.ratio < ENOUGH]
