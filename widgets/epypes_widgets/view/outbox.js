// When do values that the view moves go to the kernel?

import { same } from "./numbers.js";

/** After that long a value is taken for refused by the kernel. */
const REFUSED_MS = 3000;
/** After that long without a picture the next moves go all the same: the graph is slow, or nothing is to be shown. */
const PATIENCE_MS = 250;

/**
 * While something is moved, what it was moved to goes out when the picture of the moves before is there, along with its
 * acknowledgement: each message takes JupyterLab more time than the kernel takes to compute. The first goes at once, and
 * so does what is committed.
 * @param {(content: any) => void} send
 * @param {(callback: () => void, delay_ms: number) => void} [later]
 * @param {() => number} [now_ms]
 */
export function outbox(send, later = setTimeout, now_ms = () => performance.now()) {
  /** Moved, and not yet sent: values by name, places of sliders by the id of their model. */
  let values = {};
  let places = {};
  /** Sent, and not yet committed. */
  let open = {};
  /** Sent, and not yet seen in a frame: a frame that was computed before must not take the hand back. */
  const awaited = new Map();
  let sent_ms = -Infinity;
  let shown_ms = 0;
  let isScheduled = false;
  let isClosed = false;

  /** Take out what waits; null if that is nothing. */
  function taken() {
    if (isClosed || !(Object.keys(values).length || Object.keys(places).length)) return null;
    const moves = { values, places };
    open = { ...open, ...values };
    values = {};
    places = {};
    sent_ms = now_ms();
    return moves;
  }

  function flush() {
    const moves = taken();
    if (moves) send({ kind: "move", ...moves });
  }

  function goOn() {
    const wait_ms = sent_ms + PATIENCE_MS - now_ms();
    if (wait_ms <= 0) flush();
    else if (!isScheduled) {
      isScheduled = true;
      later(() => {
        isScheduled = false;
        if (Object.keys(values).length || Object.keys(places).length) goOn();
      }, wait_ms);
    }
  }

  return {
    set(given, commit) {
      for (const [name, value] of Object.entries(given)) awaited.set(name, { value, at_ms: now_ms() });
      values = { ...values, ...given };
      if (!commit) return goOn();
      send({ kind: "set", values });
      for (const name of Object.keys(values)) delete open[name];
      values = {};
    },
    /** A slider, by the id of its model, is being dragged, and is at this place. */
    slide(model, place) {
      places = { ...places, [model]: place };
      goOn();
    },
    /** A frame has arrived, and the one before is on the screen. */
    painted(seq) {
      sent_ms = -Infinity;
      const moves = taken();
      send({ kind: "painted", seq, ...(moves ? { move: moves } : {}), ...(shown_ms ? { shown_ms } : {}) });
    },
    /** A frame took so long from its arrival to the screen. */
    took(ms) {
      shown_ms = ms;
    },
    /** Commit what was moved by keys. */
    commit() {
      const given = { ...open, ...values };
      values = {};
      open = {};
      if (Object.keys(given).length) send({ kind: "set", values: given });
    },
    hold: (names) => send({ kind: "hold", names }),
    release(names) {
      flush();
      send({ kind: "release", names });
    },
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
