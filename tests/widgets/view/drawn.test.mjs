// Are histograms and marks drawn where their values are?
import assert from "node:assert/strict";
import { test } from "node:test";
import { fullest, heightOf, outline, shareOf, valueAt } from "../../../widgets/epypes_widgets/view/histogram.js";
import { targetLabel } from "../../../widgets/epypes_widgets/view/compare.js";
import { linePath, overlayCount, pointPath } from "../../../widgets/epypes_widgets/view/overlay.js";

const histogram = { low: 0, high: 200, bins: 2, channels: [{ name: "B", counts: [1, 5] }, { name: "G", counts: [9, 0] }] };

test("a value stands at its share of the width and back", () => {
  for (const value of [0, 33, 200]) assert.ok(Math.abs(valueAt(histogram, shareOf(histogram, value)) - value) < 1e-9);
  assert.equal(shareOf(histogram, 999), 1);
  assert.equal(valueAt(histogram, -1), 0);
});
test("a histogram of one value has a place for it", () => assert.equal(shareOf({ low: 5, high: 5 }, 5), 0.5));
test("the fullest bin of all channels is as high as the picture", () => {
  assert.equal(fullest(histogram), 9);
  assert.equal(heightOf(9, 9, false), 1);
  assert.equal(heightOf(0, 9, true), 0);
  assert.equal(heightOf(9, 9, true), 1);
});
test("few beside many can be seen by logarithm", () => assert.ok(heightOf(1, 1e6, true) > 0.04 && heightOf(1, 1e6, false) < 1e-5));
test("an outline has every bin", () => assert.equal(outline([1, 2], 2, false), "M0 1V0.5H0.5V0H1V1Z"));

test("a keypoint is a circle with a hand", () => {
  assert.match(pointPath([10, 20, 8, 90]), /^M6 20a4 4 .*M10 20l0 4$/);
  assert.equal(pointPath([10, 20, 0, -1]), "M10 20h0");
  assert.doesNotMatch(pointPath([10, 20, 8, -1]), /l/);
});
test("a contour is closed", () => {
  assert.equal(linePath([0, 0, 5, 0, 5, 5], true), "M0 0L5 0L5 5Z");
  assert.equal(linePath([0, 0, 5, 0], false), "M0 0L5 0");
  assert.equal(linePath([], true), "");
});
test("marks are counted, and those that are drawn if not all are", () => {
  assert.equal(overlayCount({ points: [1, 2], lines: [], total: 2, what: "keypoints" }), "2 keypoints");
  assert.equal(overlayCount({ points: [1, 2], lines: [], total: 9, what: "keypoints" }), "9 keypoints (2 drawn)");
  assert.equal(overlayCount(null), "");
});
test("what is compared with has a name", () => {
  const targets = [null, { kind: "default" }, { kind: "stage", token: "gray" }, { kind: "history", number: 3 }];
  assert.deepEqual(targets.map(targetLabel), ["nothing", "default", "gray", "history #3"]);
});
