// Do limits stay apart, and do the tables of colour maps have their colours?
import assert from "node:assert/strict";
import { test } from "node:test";
import { channelTable, moved, sliderOf } from "../../../widgets/epypes_widgets/view/pictures.js";

test("a colour map has a table for each channel", () => {
  assert.equal(channelTable("ff0080000000", 0), "1 0");
  assert.equal(channelTable("ff0080000000", 2), "0.502 0");
  assert.equal(channelTable("", 0), "");
});

test("black stays below white, whichever is moved", () => {
  assert.deepEqual(moved([10, 90], 0, 40, 1), [40, 90]);
  assert.deepEqual(moved([10, 90], 0, 400, 1), [89, 90]);
  assert.deepEqual(moved([10, 90], 1, -5, 1), [10, 11]);
});

test("the sliders reach from end to end of the range, and to what was typed beyond it", () => {
  assert.deepEqual(sliderOf({ range: [0, 255], limits: [0, 255], dtype: "uint8" }), { low: 0, high: 255, step: 1 });
  assert.deepEqual(sliderOf({ range: [0, 1], limits: [-1, 1], dtype: "float32" }), { low: -1, high: 1, step: 0.002 });
  assert.deepEqual(sliderOf({ range: [0, 65535], limits: [0, 65535], dtype: "uint16" }).step, 65.535);
});
