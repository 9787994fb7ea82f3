// Does the curve of a search show what was found?
import assert from "node:assert/strict";
import test from "node:test";
import { bestSoFar, reach } from "../../../widgets/epypes_widgets/view/optimise.js";

const x = (index) => index;
const y = (value) => value;

test("the line steps where it gets better, and goes on to the last trial", () => {
  assert.equal(bestSoFar([1, 0, 3, 2], "maximize", x, y), "M0.0 1.0H2.0V3.0H3.0");
  assert.equal(bestSoFar([1, 0, 3, 2], "minimize", x, y), "M0.0 1.0H1.0V0.0H3.0");
});

test("a trial that failed is no value", () => {
  assert.equal(bestSoFar([null, 2, null], "maximize", x, y), "M1.0 2.0H2.0");
  assert.equal(bestSoFar([null, null], "maximize", x, y), "");
});

test("there is room for as many trials as there are to be, but not for far more than there are", () => {
  assert.equal(reach(3, 15), 15);
  assert.equal(reach(3, 5000), 20);
  assert.equal(reach(21, 5000), 40);
  assert.equal(reach(30, 10), 30);
});
