// Are numbers read, written and stepped as a hand means them?
import assert from "node:assert/strict";
import { test } from "node:test";
import { clamped, inMs, means, modelValue, read, shortly, stepped, written } from "../../../widgets/epypes_widgets/view/numbers.js";

const row = (more = {}) => ({ names: ["x"], integer: false, odd: false, log: false, low: [0], high: [10], step: [0.1], ...more });
const odd = row({ integer: true, odd: true, low: [1], high: [31], step: [2] });
const pair = row({ names: ["lo", "hi"], integer: true, low: [0, 0], high: [255, 255], step: [1, 1] });

test("a sum of steps is written without noise", () => assert.equal(written(0.1 + 0.2), "0.3"));
test("a whole number has no point", () => assert.equal(written(5.0), "5"));
test("a duration has as many digits as can be read", () => {
  assert.deepEqual([0.04, 12.34, 431.2, 12345, null].map(inMs), ["0.0 ms", "12.3 ms", "431 ms", "12.3 s", "–"]);
});
test("a long value is cut", () => assert.equal(shortly("a".repeat(99)).length, 40));

test("what is typed is read exactly", () => assert.deepEqual(read(row(), 0, " 1.61234 "), { value: 1.61234 }));
test("an exponent is a number", () => assert.deepEqual(read(row(), 0, "1e-3"), { value: 0.001 }));
test("a word is none", () => assert.match(read(row(), 0, "much").problem, /Type a number for x, not much\./));
test("nothing is none", () => assert.match(read(row(), 0, "").problem, /Type a number for x\./));
test("infinity is none", () => assert.match(read(row(), 0, "Infinity").problem, /Type a number/));
test("a fraction is no whole number", () => assert.match(read(odd, 0, "2.5").problem, /whole numbers/));
test("the ends are told", () => assert.match(read(row(), 0, "11").problem, /its range is 0 to 10/));
test("an open end is not told", () => assert.match(read(row({ high: [null] }), 0, "-1").problem, /at least 0/));
test("an open end takes anything", () => assert.deepEqual(read(row({ high: [null] }), 0, "1e9"), { value: 1e9 }));
test("an odd number is taken without a word", () => assert.deepEqual(read(odd, 0, "9"), { value: 9 }));
test("an even number becomes the next odd one, and a notice says so", () => {
  assert.deepEqual(read(odd, 0, "8"), { value: 9, notice: "x takes odd numbers: 8 became 9." });
});
test("an even number at an even end becomes the odd one below", () => {
  assert.equal(read({ ...odd, high: [30] }, 0, "30").value, 29);
});
test("the lower value of a pair stays below the upper one", () => {
  assert.match(read(pair, 0, "201", [70, 200]).problem, /0 to 200 \(hi\)/);
  assert.deepEqual(read(pair, 0, "200", [70, 200]), { value: 200 });
  assert.match(read(pair, 1, "69", [70, 200]).problem, /70 \(lo\) to 255/);
});

test("a step is added", () => assert.equal(stepped(row(), 0, 0.2, 1), 0.3));
test("a step ends at the end", () => assert.equal(stepped(row(), 0, 10, 1), 10));
test("an odd number stays odd", () => {
  assert.equal(stepped({ ...odd, step: [1] }, 0, 5, 1), 7);
  assert.equal(stepped(odd, 0, 31, 1), 31);
  assert.equal(stepped(odd, 0, 1, -1), 1);
});
test("a logarithmic value is multiplied", () => {
  const log = row({ log: true, low: [0.01], high: [100], step: [1] });
  assert.equal(stepped(log, 0, 1, 1), 10);
  assert.equal(stepped(log, 0, 1, -1), 0.1);
  assert.equal(stepped({ ...log, integer: true, low: [1], step: [0.001] }, 0, 3, 1), 4);
});
test("a value of a pair is stepped up to its partner", () => assert.equal(stepped(pair, 0, 70, 500, [70, 200]), 200));
test("a value without a step moves by a hundredth of its range", () => {
  assert.equal(stepped(row({ step: [null] }), 0, 5, 1), 5.1);
});
test("what is clamped is of its kind", () => {
  assert.equal(clamped(odd, 0, 99), 31);
  assert.equal(clamped({ ...odd, high: [30] }, 0, 99), 29);
  assert.equal(clamped(pair, 1, 3, [70, 200]), 70);
});
test("a slider means the exact value within half a step", () => {
  assert.ok(means(row(), 0, 1.6, 1.6499));
  assert.ok(!means(row(), 0, 1.6, 1.66));
  assert.ok(means(row({ log: true, step: [0.1] }), 0, 1.1, 1));
  assert.ok(!means(row({ log: true, step: [0.1] }), 0, 1.2, 1));
});

test("a slider's place is a value of its model", () => {
  const one = { names: ["x"], integer: true };
  assert.equal(modelValue(one, [2.0000001]), 2);
  assert.equal(modelValue({ names: ["x"], log: true }, [-1]), 0.1);
  assert.deepEqual(modelValue({ names: ["lo", "hi"] }, [0.5, 1.5]), [0.5, 1.5]);
});
