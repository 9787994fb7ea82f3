// Is the final picture always the final value's, whatever becomes of the messages?
import assert from "node:assert/strict";
import { test } from "node:test";
import { failures, withBytes } from "../../../widgets/epypes_widgets/view/frames.js";
import { FRAME, newestNext, newestOnly, outbox, questions } from "../../../widgets/epypes_widgets/view/protocol.js";

test("an error stays until a better frame comes", () => {
  const order = failures();
  order.fail({ seq: 5, text: "no" });
  order.paint({ seq: 6, stale: true });
  assert.equal(order.failure.text, "no");
  order.paint({ seq: 4 });
  assert.equal(order.failure.text, "no");
  order.paint({ seq: 7 });
  assert.equal(order.failure, null);
});
test("an error that comes after a better frame does not count", () => {
  const order = failures();
  order.paint({ seq: 7 });
  order.fail({ seq: 6, text: "late" });
  assert.equal(order.failure, null);
  order.fail({ seq: 8, text: "new" });
  order.fail({ seq: 7.5, text: "older" });
  assert.equal(order.failure.text, "new");
});
test("one thing is worked on at a time, the newest next", async () => {
  const done = [];
  let finish = () => undefined;
  const next = newestNext((item) => {
    done.push(item);
    return new Promise((resolve) => (finish = resolve));
  });
  for (const item of ["a", "b", "c"]) next(item);
  assert.deepEqual(done, ["a"]);
  finish();
  await new Promise(setImmediate);
  assert.deepEqual(done, ["a", "c"]);
  finish();
  await new Promise(setImmediate);
  next("d");
  assert.deepEqual(done, ["a", "c", "d"]);
});
test("of messages that replace one another the newest passes", () => {
  const isNewest = newestOnly();
  assert.deepEqual([1, 3, 2, 3, 4].map(isNewest), [true, true, false, true, true]);
});

test("one question is asked at a time, the latest next", async () => {
  const asked = [];
  const open = questions((question) => asked.push(question));
  for (const question of ["a", "b", "c"]) open.ask(question);
  assert.deepEqual(asked, ["a"]);
  assert.ok(open.answer(1));
  await new Promise(setImmediate);
  assert.deepEqual(asked, ["a", "c"]);
  assert.ok(!open.answer(1));
});
test("a lost answer is not waited for", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const asked = [];
  const open = questions((question) => asked.push(question));
  open.ask("a");
  open.ask("b");
  context.mock.timers.tick(1001);
  await new Promise(setImmediate);
  assert.deepEqual(asked, ["a", "b"]);
});

function recorded() {
  const sent = [];
  let waiting = [];
  let now_ms = 0;
  const out = outbox((content) => sent.push(content), (callback, delay_ms) => waiting.push([now_ms + delay_ms, callback]), () => now_ms);
  const later = (ms) => {
    now_ms += ms;
    const due = waiting.filter(([at_ms]) => at_ms <= now_ms);
    waiting = waiting.filter(([at_ms]) => at_ms > now_ms);
    due.forEach(([, callback]) => callback());
  };
  return { out, sent, later };
}
test("the first move goes at once, and those until its picture is there are one message with its acknowledgement", () => {
  const { out, sent } = recorded();
  for (let x = 0; x < 50; x++) out.set({ x, y: 1 }, false);
  for (let place = 0; place < 9; place++) out.slide("m", place);
  assert.deepEqual(sent, [{ kind: "move", values: { x: 0, y: 1 }, places: {} }]);
  out.painted(7);
  assert.deepEqual(sent.slice(1), [{ kind: "painted", seq: 7, move: { values: { x: 49, y: 1 }, places: { m: 8 } } }]);
  out.painted(8);
  assert.deepEqual(sent.slice(2), [{ kind: "painted", seq: 8 }]);
});
test("moves do not wait for the picture of a slow graph for ever", () => {
  const { out, sent, later } = recorded();
  for (let place = 0; place < 120; place++) {
    out.slide("m", place);
    later(16);
  }
  later(250);
  assert.equal(sent.at(-1).places.m, 119);
  assert.ok(sent.length <= 10, `${sent.length} messages in 2 s`);
});
test("when a slider is let go its last place is told before", () => {
  const { out, sent } = recorded();
  out.slide("m", 1);
  out.slide("m", 2);
  out.release(["x"]);
  assert.deepEqual(sent.map(({ kind }) => kind), ["move", "move", "release"]);
  assert.deepEqual(sent[1].places, { m: 2 });
});
test("a committed value goes at once and takes what waits along", () => {
  const { out, sent, later } = recorded();
  out.set({ x: 1 }, false);
  out.set({ x: 2 }, false);
  out.set({ y: 2 }, true);
  later(1000);
  assert.deepEqual(sent.slice(1), [{ kind: "set", values: { x: 2, y: 2 } }]);
});
test("what was moved by keys is committed once", () => {
  const { out, sent } = recorded();
  out.set({ x: 1 }, false);
  out.commit();
  out.commit();
  assert.deepEqual(sent.map(({ kind }) => kind), ["move", "set"]);
});
test("an older frame does not take back what the hand did", () => {
  const { out, later } = recorded();
  out.set({ x: 5 }, true);
  assert.ok(!out.takes("x", 4));
  assert.ok(out.takes("x", 5));
  assert.ok(out.takes("x", 4));
  out.set({ x: 9 }, true);
  later(3001);
  assert.ok(out.takes("x", 4));
});
test("an undo may give back any value", () => {
  const { out } = recorded();
  out.set({ x: 5 }, true);
  out.forget();
  assert.ok(out.takes("x", 4));
});

test("bytes belong to the pictures in order, and texts have none", () => {
  const pictures = ["image/jpeg", "text/plain", "image/png"].map((media_type) => ({ media_type }));
  assert.deepEqual(withBytes(pictures, ["a", "b"]).map(({ bytes }) => bytes), ["a", undefined, "b"]);
});

test("a video's slider goes with the moves, the newest frame next, and is not taken back by an older picture", () => {
  const sent = [];
  let now_ms = 0;
  const out = outbox((content) => sent.push(content), () => undefined, () => now_ms);
  out.seek(3);
  out.seek(4);
  out.seek(5);
  assert.deepEqual(sent, [{ kind: "move", values: {}, places: {}, image: 3 }]);
  out.painted(1);
  assert.deepEqual(sent[1], { kind: "painted", seq: 1, move: { values: {}, places: {}, image: 5 } });
  assert.ok(!out.takes(FRAME, 3));
  assert.ok(out.takes(FRAME, 5));
  assert.ok(out.takes(FRAME, 9));
  out.painted(2);
  assert.deepEqual(sent[2], { kind: "painted", seq: 2 });
});
