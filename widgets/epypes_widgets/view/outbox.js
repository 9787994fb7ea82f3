// When do values that the view moves go to the kernel?

import { same } from "./numbers.js";

/** After that long a value is taken for refused by the kernel. */
const REFUSED_MS = 3000;

/**
 * Values go out once per painted frame at most while they are moved, and at once when they are committed.
 * @param {(content: any) => void} send
 * @param {(callback: () => void) => number} [schedule]
 * @param {() => number} [now_ms]
 */
export function outbox(send, schedule = (callback) => requestAnimationFrame(callback), now_ms = () => performance.now()) {
  /** Moved, and not yet sent. */
  let moved = {};
  /** Sent, and not yet committed. */
  let open = {};
  /** Sent, and not yet seen in a frame: a frame that was computed before must not take the hand back. */
  const awaited = new Map();
  let isScheduled = false;
  let isClosed = false;

  function flush() {
    isScheduled = false;
    if (isClosed || !Object.keys(moved).length) return;
    send({ kind: "set", values: moved, commit: false });
    open = { ...open, ...moved };
    moved = {};
  }

  return {
    set(values, commit) {
      for (const [name, value] of Object.entries(values)) awaited.set(name, { value, at_ms: now_ms() });
      moved = { ...moved, ...values };
      if (commit) {
        send({ kind: "set", values: moved, commit: true });
        for (const name of Object.keys(moved)) delete open[name];
        moved = {};
      } else if (!isScheduled) {
        isScheduled = true;
        schedule(flush);
      }
    },
    /** Commit what was moved by keys. */
    commit() {
      const values = { ...open, ...moved };
      moved = {};
      open = {};
      if (Object.keys(values).length) send({ kind: "set", values, commit: true });
    },
    hold: (names) => send({ kind: "hold", names }),
    release: (names) => send({ kind: "release", names }),
    /** Whether what a frame says of a value is newer than what the hand did here. */
    takes(name, value) {
      const own = awaited.get(name);
      if (own && !same(own.value, value) && now_ms() - own.at_ms < REFUSED_MS) return false;
      awaited.delete(name);
      return true;
    },
    /** Values are given by something else now, as an undo. */
    forget: () => awaited.clear(),
    close() {
      isClosed = true;
    },
  };
}
