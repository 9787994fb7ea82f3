// Where is a picture in its box, and which of its pixels is under the pointer?

/** @typedef {{width: number, height: number}} Size in pixels
 *  @typedef {{scale: number, x: number, y: number}} Place box pixels per picture pixel, and the picture's corner */

export const MAX_SCALE = 64;
/** From here on single pixels are looked at, so they are drawn as squares. */
export const PIXELATED_SCALE = 3;

/** Return the place at which all of a picture is seen, in the middle; small pictures are enlarged at most 8 times. */
export function fitted(size, room) {
  const scale = Math.min(room.width / size.width, room.height / size.height, 8) || 1;
  return kept({ scale, x: 0, y: 0 }, size, room);
}

/** Return a place moved so that no room stays empty that the picture could fill. */
export function kept(place, size, room) {
  const along = (at, length, space) => (length <= space ? (space - length) / 2 : Math.min(0, Math.max(space - length, at)));
  return {
    scale: place.scale,
    x: along(place.x, size.width * place.scale, room.width),
    y: along(place.y, size.height * place.scale, room.height),
  };
}

/** Return the place at another scale; what is at a point of the box stays there. */
export function zoomed(place, scale, point, size, room) {
  const least = Math.min(fitted(size, room).scale, 1);
  const next = Math.min(MAX_SCALE, Math.max(least, scale));
  const ratio = next / place.scale;
  const moved = { scale: next, x: point.x - (point.x - place.x) * ratio, y: point.y - (point.y - place.y) * ratio };
  return kept(moved, size, room);
}

/** Return the place after a drag. */
export function panned(place, dx, dy, size, room) {
  return kept({ scale: place.scale, x: place.x + dx, y: place.y + dy }, size, room);
}

/** Return a point of the box in pixels of the picture, with fractions. */
export function onPicture(place, point) {
  return { x: (point.x - place.x) / place.scale, y: (point.y - place.y) / place.scale };
}

/** Return the pixel under a point of the box; null beside the picture. */
export function pixelAt(place, point, size) {
  const { x, y } = onPicture(place, point);
  const pixel = { x: Math.floor(x), y: Math.floor(y) };
  const inside = pixel.x >= 0 && pixel.y >= 0 && pixel.x < size.width && pixel.y < size.height;
  return inside ? pixel : null;
}

/** Return the middle of a pixel, in the box. */
export function inBox(place, pixel) {
  return { x: place.x + (pixel.x + 0.5) * place.scale, y: place.y + (pixel.y + 0.5) * place.scale };
}

/** Return where a note of some size stands beside a point without leaving the room. */
export function beside(point, note, room, gap = 14) {
  const along = (at, length, space) => {
    const after = at + gap;
    const placed = after + length <= space ? after : at - gap - length;
    return Math.max(0, Math.min(placed, space - length));
  };
  return { x: along(point.x, note.width, room.width), y: along(point.y, note.height, room.height) };
}

/** Return how many pixels of the left of a picture are not covered by the other one in a wipe. */
export function wiped(share, room, place) {
  return share * room.width - place.x;
}
