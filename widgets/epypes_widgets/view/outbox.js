// When do values that the view moves go to the kernel?

/**
 * Values go out once per painted frame at most while they are moved, and at once when they are committed.
 * @param {(content: any) => void} send
 * @param {(callback: () => void) => number} [schedule]
 */
export function outbox(send, schedule = (callback) => requestAnimationFrame(callback)) {
  /** Moved, and not yet sent. */
  let moved = {};
  /** Sent, and not yet committed. */
  let open = {};
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
    isPending: (name) => name in moved,
    close() {
      isClosed = true;
    },
  };
}
