// What is said of the picture in words?
import { element, note, say } from "./elements.js";
import { inMs } from "./numbers.js";
import { overlayCount } from "./overlay.js";

/** The line above the picture, and the one below it that says what went wrong. */
export function headerPart(panel) {
  const token = element("span", "epypes-token");
  const kind = element("span", "epypes-kind");
  const badge = element("span", "epypes-badge", {}, "stale");
  const marks = element("span", "epypes-marks");
  const count = element("span", "epypes-count");
  const times = element("span", "epypes-times");
  const root = element("figcaption", "epypes-header", {}, token, kind, badge, marks, count, times);
  const status = element("div", "epypes-status", { role: "status", "aria-live": "polite" });
  let noted = "";
  let failed = "";
  let passes = false;

  function tellTimes(compute, screen) {
    note(times, "data-compute", String(compute));
    say(times, `compute ${inMs(compute)} / to screen ${inMs(screen)}`);
  }

  function tell() {
    say(status, failed || noted);
    status.classList.toggle("epypes-at-fault", Boolean(failed));
  }

  return {
    element: root,
    status,
    frame({ frame, main }) {
      if (passes) noted = "";
      tell();
      say(token, frame.token);
      say(kind, main.shape ? `${main.dtype} ${main.shape}` : "");
      say(marks, overlayCount(main.overlay));
      say(count, `${frame.ran} ran, ${frame.reused} reused`);
      const each = Object.entries(frame.times_ms ?? {}).map(([name, ms]) => `${name}: ${inMs(ms)}`);
      note(count, "title", each.join("\n"));
      tellTimes(frame.compute_ms, frame.to_screen_ms);
    },
    latency: (message) => tellTimes(Number(times.dataset.compute ?? 0), message.to_screen_ms),
    failure(failure) {
      failed = failure ? failure.text : "";
      tell();
    },
    /** Say something that is no failure of a function; it gives way to one, and to the next frame if it passes. */
    tell(text, isPassing = false) {
      noted = text;
      passes = isPassing;
      tell();
    },
  };
}
