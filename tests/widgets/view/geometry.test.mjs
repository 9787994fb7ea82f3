// Is the picture where the hand has put it?
import assert from "node:assert/strict";
import { test } from "node:test";
import { beside } from "../../../widgets/epypes_widgets/view/probe.js";
import { between, resized, shifted, whole } from "../../../widgets/epypes_widgets/view/roi.js";
import { fitted, inBox, kept, onPicture, pixelAt, zoomed } from "../../../widgets/epypes_widgets/view/stage.js";

const size = { width: 400, height: 300 };
const room = { width: 800, height: 400 };

test("a picture that fits is in the middle", () => {
  const place = fitted(size, room);
  assert.equal(place.scale, 400 / 300);
  assert.equal(place.y, 0);
  assert.ok(Math.abs(place.x - (800 - (400 * 4) / 3) / 2) < 1e-9);
});
test("a tiny picture is not made a mosaic", () => assert.equal(fitted({ width: 2, height: 2 }, room).scale, 8));
test("zooming keeps the pixel under the pointer", () => {
  const start = zoomed(fitted(size, room), 4, { x: 400, y: 200 }, size, room);
  const point = { x: 300, y: 150 };
  const before = onPicture(start, point);
  const after = onPicture(zoomed(start, 9, point, size, room), point);
  assert.ok(Math.abs(before.x - after.x) < 1e-9 && Math.abs(before.y - after.y) < 1e-9);
});
test("zooming ends", () => {
  assert.equal(zoomed(fitted(size, room), 1e9, { x: 0, y: 0 }, size, room).scale, 64);
  assert.equal(zoomed(fitted(size, room), 0, { x: 0, y: 0 }, size, room).scale, 1);
});
test("panning stops at the edge of the picture", () => {
  const close = zoomed(fitted(size, room), 8, { x: 0, y: 0 }, size, room);
  assert.equal(kept({ ...close, x: close.x + 1e6 }, size, room).x, 0);
  assert.equal(kept({ ...close, x: close.x - 1e6 }, size, room).x, 800 - 3200);
});
test("a picture smaller than its room can't be lost", () => {
  const place = fitted(size, room);
  assert.equal(kept({ ...place, x: place.x + 500 }, size, room).x, place.x);
});
test("a pixel is found where it is drawn", () => {
  const place = zoomed(fitted(size, room), 5, { x: 10, y: 10 }, size, room);
  assert.deepEqual(pixelAt(place, inBox(place, { x: 17, y: 23 }), size), { x: 17, y: 23 });
});
test("beside the picture is no pixel", () => assert.equal(pixelAt(fitted(size, room), { x: 1, y: 1 }, size), null));
test("a note stays in the room", () => {
  const note = { width: 100, height: 50 };
  for (const point of [{ x: 0, y: 0 }, { x: 800, y: 400 }, { x: 800, y: 0 }, { x: 400, y: 399 }]) {
    const at = beside(point, note, room);
    assert.ok(at.x >= 0 && at.y >= 0 && at.x + 100 <= 800 && at.y + 50 <= 400);
  }
});

test("a rectangle is drawn from any corner", () => {
  assert.deepEqual(between({ x: 30.7, y: 40 }, { x: 10.2, y: 20 }, size), [10, 20, 21, 20]);
});
test("a rectangle has a pixel at least", () => assert.deepEqual(between({ x: 5, y: 5 }, { x: 5, y: 5 }, size), [5, 5, 1, 1]));
test("a rectangle is cut to the picture", () => {
  assert.deepEqual(between({ x: -9, y: -9 }, { x: 999, y: 999 }, size), whole(size));
  assert.deepEqual(between({ x: 999, y: 999 }, { x: 1500, y: 1500 }, size), [399, 299, 1, 1]);
});
test("a rectangle that is moved keeps its size", () => assert.deepEqual(shifted([10, 10, 50, 40], 1e4, -1e4, size), [350, 0, 50, 40]));
test("each handle moves its own sides", () => {
  assert.deepEqual(resized([10, 20, 30, 40], "e", 5, 99, size), [10, 20, 35, 40]);
  assert.deepEqual(resized([10, 20, 30, 40], "nw", -5, 5, size), [5, 25, 35, 35]);
  assert.deepEqual(resized([10, 20, 30, 40], "s", 5, 7, size), [10, 20, 30, 47]);
});
test("sides that cross change places", () => assert.deepEqual(resized([10, 20, 30, 40], "w", 50, 0, size), [40, 20, 20, 40]));
