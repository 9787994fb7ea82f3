// How does a rectangle of whole pixels follow the hand within its picture?

/** @typedef {[number, number, number, number]} Rectangle x, y, width, height */

export const HANDLES = ["nw", "n", "ne", "e", "se", "s", "sw", "w"];

/** Return all of a picture. */
export function whole(size) {
  return [0, 0, size.width, size.height];
}

/** Return the rectangle between two points, at least a pixel wide, within the picture. */
export function between(one, other, size) {
  const along = (a, b, length) => {
    const from = Math.min(Math.max(Math.floor(Math.min(a, b)), 0), length - 1);
    const to = Math.max(Math.min(Math.ceil(Math.max(a, b)), length), from + 1);
    return [from, to - from];
  };
  const [x, width] = along(one.x, other.x, size.width);
  const [y, height] = along(one.y, other.y, size.height);
  return [x, y, width, height];
}

/** Return a rectangle moved by whole pixels; it stays as large as it is, and inside. */
export function shifted([x, y, width, height], dx, dy, size) {
  const along = (at, by, length, space) => Math.max(0, Math.min(Math.round(at + by), space - length));
  return [along(x, dx, width, size.width), along(y, dy, height, size.height), width, height];
}

/** Return a rectangle with the sides that a handle stands for moved; sides that cross change places. */
export function resized([x, y, width, height], handle, dx, dy, size) {
  const left = x + (handle.includes("w") ? dx : 0);
  const right = x + width + (handle.includes("e") ? dx : 0);
  const top = y + (handle.includes("n") ? dy : 0);
  const bottom = y + height + (handle.includes("s") ? dy : 0);
  const rounded = (px, py) => ({ x: Math.round(px), y: Math.round(py) });
  return between(rounded(left, top), rounded(right, bottom), size);
}

/** Whether a value can be drawn: four numbers. */
export function isRectangle(value) {
  return Array.isArray(value) && value.length === 4 && value.every((part) => Number.isFinite(part));
}
