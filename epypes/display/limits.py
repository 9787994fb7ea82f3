"""How large may a picture be, as SVG and as HTML, in characters?

A saved notebook keeps every picture twice, and is read, compared and sent: so many functions take so much room, and
no more.
"""

from __future__ import annotations

from typing import Final

CHARACTERS: Final = 20_000
CHARACTERS_OF_A_VERTEX: Final = 600
# All thumbnails of a picture. Base64 makes four characters of three bytes.
THUMBNAIL_CHARACTERS: Final = 80_000
# More are no overview.
MOST_THUMBNAILS: Final = 24
