// Whether the kernel of a panel is still there.

const RESTARTED = "The kernel was restarted: run the cells again, up to this one.";
const GONE = "The kernel of this panel has ended: run the cells again, up to this one.";
const LATE = "The kernel does not answer: it is busy, or was restarted. After a restart run the cells again, up to this one.";
/** After that long without a message the kernel is asked, and is late after as long again. */
const SILENCE_MS = 5_000;
/** Statuses of JupyterLab's kernels after which no widget is answered any more. */
const ENDS = { restarting: RESTARTED, autorestarting: RESTARTED, terminating: GONE, dead: GONE };
/** Messages that nobody waits for. */
const UNASKED = ["ready", "closed", "painted", "probe"];

/**
 * Watch the kernel behind a widget's model until the signal; ``ended(text)`` is called when it is gone, and ``late(text)``
 * when it does not answer, which is all that can be known in a front end that says nothing of its kernels; with no text
 * when it does again.
 *
 * JupyterLab's kernel has signals. All of ipywidgets' front ends mark the models of a kernel that is gone, also those of
 * a saved notebook: their class is on the element.
 */
export function watchKernel(model, el, { ended, late, signal }) {
  const kernel = model.widget_manager?.kernel;
  let text = "";
  let waiting = 0;
  let isLate = false;

  function end(why) {
    answered();
    if (text !== why && text !== RESTARTED) ended((text = why));
  }

  function answered() {
    clearTimeout(waiting);
    waiting = 0;
    if (isLate) late("");
    isLate = false;
  }

  function tellLate() {
    isLate = true;
    late(LATE);
  }

  const onStatus = (_kernel, status) => ENDS[status] && end(ENDS[status]);
  const onDisposed = () => end(GONE);
  const onLive = () => end(RESTARTED);
  kernel?.statusChanged?.connect(onStatus);
  kernel?.disposed?.connect(onDisposed);
  model.on("comm_live_update", onLive);
  signal.addEventListener("abort", () => {
    answered();
    kernel?.statusChanged?.disconnect(onStatus);
    kernel?.disposed?.disconnect(onDisposed);
    model.off("comm_live_update", onLive);
  });
  if (el.closest(".jupyter-widgets-disconnected")) queueMicrotask(() => end(GONE));

  function ask() {
    send({ kind: "ping" });
    if (!text) waiting = setTimeout(tellLate, SILENCE_MS);
  }

  /** Send to the kernel, if it is there. */
  function send(content) {
    if (text) return;
    try {
      model.send(content);
    } catch {
      return void end(GONE);
    }
    if (!UNASKED.includes(content.kind)) waiting ||= setTimeout(ask, SILENCE_MS);
  }

  return { answered, send };
}
