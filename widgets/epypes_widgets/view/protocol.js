// The messages of the view: which of them counts, and when values that were moved go to the kernel.
import { same } from "./numbers.js";

/** After that long an answer is taken for lost, and a value for refused by the kernel. */
const LOST_MS = 1000;
const REFUSED_MS = 3000;
/** After that long without a picture the next moves go all the same: the graph is slow, or nothing is to be shown. */
const PATIENCE_MS = 250;

/** Stands for the frame of a video where values are known by name: no hyperparameter is called so. */
export const FRAME = Symbol("frame of the video");

/** Lets through what is newest by its number; for messages that replace one another. */
export function newestOnly() {
  let newest = -Infinity;
  return (seq) => {
    if (seq < newest) return false;
    newest = seq;
    return true;
  };
}

/** Works on one thing at a time, the newest next. */
export function newestNext(work) {
  let isBusy = false;
  let waiting = null;
  return async (given) => {
    if (isBusy) {
      waiting = given;
      return;
    }
    isBusy = true;
    for (let next = given; next; [next, waiting] = [waiting, null]) await work(next);
    isBusy = false;
  };
}

/** Asks one question at a time, the newest next; an answer that does not come, or a question that is not asked, is not waited for. */
export function questions(ask) {
  let id = 0;
  let answered = () => undefined;
  const next = newestNext((question) => new Promise((resolve) => {
    answered = resolve;
    setTimeout(resolve, LOST_MS);
    if (ask(question, ++id) === false) resolve();
  }));
  return {
    ask: next,
    /** Whether this answers the last question. */
    answer(given) {
      const isLast = given === id;
      if (isLast) answered();
      return isLast;
    },
  };
}

/**
 * While something is moved, what it was moved to goes out when the picture of the moves before is there, along with its
 * acknowledgement: each message takes JupyterLab more time than the kernel takes to compute. The first goes at once, and
 * so does what is committed.
 * @param {(content: any) => void} send
 * @param {(callback: () => void, delay_ms: number) => any} [later]
 * @param {() => number} [now_ms]
 */
export function outbox(send, later = setTimeout, now_ms = () => performance.now()) {
  /** Moved, and not yet sent: values by name, places of sliders by the id of their model, the frame of a video. */
  let values = {};
  let places = {};
  let image = null;
  /** Sent, and not yet committed. */
  let open = {};
  /** Sent, and not yet seen in a frame: a frame that was computed before must not take the value back. */
  const awaited = new Map();
  let sent_ms = -Infinity;
  let shown_ms = 0;
  let isScheduled = false;
  let isClosed = false;

  const isEmpty = () => isClosed || !(Object.keys(values).length || Object.keys(places).length || image !== null);

  function taken() {
    const moves = { values, places, ...(image === null ? {} : { image }) };
    open = { ...open, ...values };
    values = {};
    places = {};
    image = null;
    sent_ms = now_ms();
    return moves;
  }

  function flush() {
    if (!isEmpty()) send({ kind: "move", ...taken() });
  }

  function goOn() {
    const wait_ms = sent_ms + PATIENCE_MS - now_ms();
    if (wait_ms <= 0) flush();
    else if (!isScheduled) {
      isScheduled = true;
      later(() => {
        isScheduled = false;
        if (!isEmpty()) goOn();
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
    /** The slider of a video is at this frame. */
    seek(index) {
      image = index;
      awaited.set(FRAME, { value: index, at_ms: now_ms() });
      goOn();
    },
    /** A frame has arrived, and the one before is on the screen, which took so long. */
    painted(seq) {
      sent_ms = -Infinity;
      send({ kind: "painted", seq, ...(isEmpty() ? {} : { move: taken() }), ...(shown_ms ? { shown_ms } : {}) });
    },
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
    /** Whether what a frame has of a value is newer than what was moved here. */
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
