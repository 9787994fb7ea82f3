"""How large is a token, and how is it painted?"""

from __future__ import annotations

import base64
from typing import Final

from epypes.display.layout.geometry import Box, Point
from epypes.display.markup import cut_name, short_name
from epypes.display.paint.marks import LINE_PX, TITLE_CHARACTERS, text_lines, text_width, vertex
from epypes.display.views.graphview import TokenView

_THUMB_WIDTH: Final = 128
_THUMB_HEIGHT: Final = 96


def token_box(token: TokenView) -> Box:
    """Return the shape and size of a token."""
    lines = _token_lines(token)
    if token.preview and token.preview.picture:
        return Box("box", max(_THUMB_WIDTH + 12, text_width(*lines)), _THUMB_HEIGHT + 2 * LINE_PX + 16)
    if token.role == "hyperparameter":
        return Box("hexagon", text_width(*lines) + 14, LINE_PX + 12)
    return Box("ellipse", text_width(*lines) * 1.18, LINE_PX * len(lines) + 16)


def paint_token(token: TokenView, box: Box, centre: Point) -> str:
    """Paint a token as an element with its title."""
    lines = _token_lines(token)
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    if box.shape == "box":
        body = (
            f'<rect class="shape" x="{x:.1f}" y="{y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" rx="10"/>'
        )
        body += text_lines(lines, (centre[0], y + LINE_PX + 4)) + _thumbnail(token, centre[0], y + 2 * LINE_PX + 8)
    elif box.shape == "hexagon":
        body = f'<polygon class="shape" points="{_hexagon(x, y, box)}"/>' + text_lines(lines, centre)
    else:
        body = (
            f'<ellipse class="shape" cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" '
            f'rx="{box.width / 2:.1f}" ry="{box.height / 2:.1f}"/>'
        ) + text_lines(lines, centre)
    detail = token.preview.detail if token.preview else "no value"
    state = "" if token.state == "static" else f": {detail}, {token.state}"
    if token.first:
        # A dot, since a line of text would change the size of the box with the value.
        body += f'<circle class="dot" cx="{x + box.width - 11:.1f}" cy="{y + 3:.1f}" r="3.5"/>'
        state += f", first {token.first}"
    states = (token.role, token.state, *(("changed",) if token.first else ()))
    return vertex("token", token.name, states, _title(token, state), body)


def _token_lines(token: TokenView) -> tuple[str, ...]:
    name = short_name(token.name)
    if token.role == "hyperparameter" and token.preview:
        return (f"{name} = {token.preview.text}",)
    if token.state in ("missing", "left out"):
        return name, token.state
    return (name, token.preview.text) if token.preview else (name,)


def _title(token: TokenView, state: str) -> str:
    kind = "hyperparameter token" if token.role == "hyperparameter" else "token"
    return f"{kind} {cut_name(token.name, TITLE_CHARACTERS)}{state}"


def _hexagon(x: float, y: float, box: Box) -> str:
    cut = 10.0
    right, bottom, middle = x + box.width, y + box.height, y + box.height / 2
    points = (
        (x, middle),
        (x + cut, y),
        (right - cut, y),
        (right, middle),
        (right - cut, bottom),
        (x + cut, bottom),
    )
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def _thumbnail(token: TokenView, x: float, y: float) -> str:
    picture = token.preview.picture if token.preview else None
    if picture is None:
        return ""
    scale = min(_THUMB_WIDTH / picture.width, _THUMB_HEIGHT / picture.height)
    width, height = picture.width * scale, picture.height * scale
    data = base64.b64encode(picture.data).decode()
    return (
        f'<image x="{x - width / 2:.1f}" y="{y + (_THUMB_HEIGHT - height) / 2:.1f}" width="{width:.1f}" '
        f'height="{height:.1f}" href="data:{picture.media_type};base64,{data}"/>'
    )
