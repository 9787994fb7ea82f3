// Does the view notice that its kernel is gone, in any front end?
import assert from "node:assert/strict";
import { mock, test } from "node:test";

import { watchKernel } from "../../../widgets/epypes_widgets/view/kernel.js";

function signal() {
  const slots = new Set();
  return {
    connect: (slot) => slots.add(slot),
    disconnect: (slot) => slots.delete(slot),
    emit: (...given) => [...slots].forEach((slot) => slot(null, ...given)),
    get count() { return slots.size; },
  };
}

function watched({ kernel = { statusChanged: signal(), disposed: signal() }, isDisconnected = false } = {}) {
  const said = [];
  const sent = [];
  const closing = new AbortController();
  const listeners = new Map();
  const model = {
    widget_manager: kernel && { kernel },
    on: (event, listener) => listeners.set(event, listener),
    off: (event) => listeners.delete(event),
    send: (content) => sent.push(content.kind),
  };
  const el = { closest: () => (isDisconnected ? {} : null) };
  const tell = (kind) => (text) => said.push(`${kind}: ${text.split(/[:;]/)[0]}`);
  return { model, kernel, said, sent, closing, listeners, watch: watchKernel(model, el, { ended: tell("ended"), late: tell("late"), signal: closing.signal }) };
}

for (const status of ["restarting", "autorestarting"]) {
  test(`${status} is a restart, whatever comes after it`, () => {
    const { kernel, said, sent, watch } = watched();
    for (const each of ["busy", "idle", status, "dead"]) kernel.statusChanged.emit(each);
    kernel.disposed.emit();
    watch.send({ kind: "set" });
    assert.deepEqual([said, sent], [["ended: The kernel was restarted"], []]);
  });
}

test("a kernel that is shut down has ended", () => {
  const { kernel, said } = watched();
  kernel.disposed.emit();
  assert.deepEqual(said, ["ended: The kernel of this panel has ended"]);
});

test("a front end without signals marks the model", () => {
  const { listeners, said } = watched({ kernel: null });
  listeners.get("comm_live_update")();
  assert.deepEqual(said, ["ended: The kernel was restarted"]);
});

test("a model of a saved notebook has no kernel from the start", async () => {
  const { said } = watched({ kernel: null, isDisconnected: true });
  await Promise.resolve();
  assert.deepEqual(said, ["ended: The kernel of this panel has ended"]);
});

test("a message that can't be sent means that the kernel is gone", () => {
  const { model, said, watch } = watched({ kernel: null });
  model.send = () => { throw new Error("Cannot send"); };
  watch.send({ kind: "set" });
  assert.deepEqual(said, ["ended: The kernel of this panel has ended"]);
});

test("a kernel that is silent is asked, and told of when it does not answer", () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  const { said, sent, watch } = watched({ kernel: null });
  watch.send({ kind: "probe" });
  mock.timers.tick(60_000);
  watch.send({ kind: "set" });
  watch.send({ kind: "set" });
  mock.timers.tick(4_000);
  watch.answered();
  mock.timers.tick(60_000);
  watch.send({ kind: "move" });
  mock.timers.tick(5_001);
  assert.deepEqual([sent, said], [["probe", "set", "set", "move", "ping"], []]);
  mock.timers.tick(5_001);
  watch.answered();
  watch.answered();
  assert.deepEqual(said, ["late: The kernel does not answer", "late: "]);
  mock.timers.reset();
});

test("a view that is closed listens to nothing", () => {
  const { kernel, listeners, closing } = watched();
  closing.abort();
  assert.deepEqual([kernel.statusChanged.count, kernel.disposed.count, listeners.size], [0, 0, 0]);
});
