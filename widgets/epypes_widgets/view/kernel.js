// Whether the kernel of a panel is still there.

const RESTARTED = "The kernel was restarted: run this cell again.";
const GONE = "The kernel of this panel has ended: run this cell again.";
const LATE = "The kernel has not answered for 10 s: it is busy, or was restarted. After a restart run this cell again.";
const LATE_MS = 10_000;
/** Statuses of JupyterLab's kernels after which no widget is answered any more. */
const ENDS = { restarting: RESTARTED, autorestarting: RESTARTED, terminating: GONE, dead: GONE };
const UNANSWERED = ["ready", "closed", "painted", "hold", "release", "probe"];

/**
 * Watch the kernel behind a widget's model until the signal; ``ended(text)`` is called when it is gone, and ``late(text)``
 * when it has not answered for long, which is all that can be known in a front end without a word on its kernels.
 *
 * JupyterLab's kernel has signals. All of ipywidgets' front ends mark the models of a kernel that is gone, also those of
 * a saved notebook: their class is on the element.
 */
export function watchKernel(model, el, { ended, late, signal }) {
  const kernel = model.widget_manager?.kernel;
  let text = "";
  let waiting = 0;

  function end(why) {
    answered();
    if (text !== why && text !== RESTARTED) ended((text = why));
  }

  function answered() {
    clearTimeout(waiting);
    waiting = 0;
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

  return {
    answered,
    /** Send to the kernel, if it is there. */
    send(content) {
      if (text) return;
      try {
        model.send(content);
      } catch {
        end(GONE);
      }
      if (!text && !UNANSWERED.includes(content.kind)) waiting ||= setTimeout(() => late(LATE), LATE_MS);
    },
  };
}
