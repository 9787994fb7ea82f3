// What does the screen show of a token, and what does it answer?
//
// The kernel sends one frame at a time and waits for "painted" before the next, so no queue is needed here.

/**
 * @typedef {object} Frame
 * @property {"frame"} kind
 * @property {number} seq rises with every frame and every error
 * @property {string} token
 * @property {Record<string, unknown>} values the hyperparameters that it was computed with
 * @property {string} media_type "image/jpeg", "image/png" or "text/plain"
 * @property {string} [text] instead of a picture
 * @property {string} [shape]
 * @property {string} [dtype]
 * @property {number} compute_ms
 * @property {number | null} to_screen_ms of the frame before
 * @property {Record<string, number>} times_ms by function that ran
 * @property {number} ran
 * @property {number} reused
 * @property {boolean} [stale] the last values failed, so this is from the last run that did not
 *
 * @typedef {{kind: "error", seq: number, text: string, function: string}} Failure
 * @typedef {{kind: "latency", seq: number, to_screen_ms: number}} Latency
 */

/**
 * @param {string} tag
 * @param {string} name
 * @param {Record<string, string>} [attributes]
 */
function element(tag, name, attributes = {}) {
  const made = document.createElement(tag);
  made.className = name;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

/** @param {HTMLElement} el */
function build(el) {
  const root = element("figure", "epypes-view epypes-empty");
  const header = element("figcaption", "epypes-header");
  const token = element("span", "epypes-token");
  const kind = element("span", "epypes-kind");
  const badge = element("span", "epypes-badge");
  const functions = element("span", "epypes-count");
  const times = element("span", "epypes-times");
  const box = element("div", "epypes-box");
  const img = /** @type {HTMLImageElement} */ (element("img", "epypes-picture", { alt: "", hidden: "" }));
  const text = element("pre", "epypes-text", { hidden: "" });
  const status = element("div", "epypes-status", { role: "status", "aria-live": "polite" });
  badge.textContent = "stale";
  header.append(token, kind, badge, functions, times);
  box.append(img, text);
  root.append(header, box, status);
  el.append(root);
  return { root, token, kind, functions, times, img, text, status };
}

/** @param {number | null | undefined} ms */
const inMs = (ms) => (ms === null || ms === undefined ? "–" : `${ms < 100 ? ms.toFixed(1) : Math.round(ms)} ms`);

/** @param {Frame} frame */
function alternative(frame) {
  const values = Object.entries(frame.values).map(([name, value]) => `${name} ${value}`);
  return `${frame.token}${values.length ? ` with ${values.join(", ")}` : ""}`;
}

/** Resolves when the browser has had its chance to paint; at once in a hidden page, which never paints. */
const nextPaint = () =>
  new Promise((resolve) => (document.hidden ? resolve(0) : requestAnimationFrame(() => resolve(0))));

/** @param {{model: any, el: HTMLElement}} context */
function render({ model, el }) {
  const parts = build(el);
  let url = "";
  let received = 0;
  let painted = 0;
  /** @type {Failure | null} */
  let failure = null;

  /** @param {number} compute @param {number | null} screen */
  function tellTimes(compute, screen) {
    parts.times.dataset.compute = String(compute);
    parts.times.textContent = `compute ${inMs(compute)} / to screen ${inMs(screen)}`;
  }

  function tellFailure() {
    const text = failure ? failure.text : "";
    // Written only when it changes: a screen reader would say it again with every frame.
    if (parts.status.textContent !== text) parts.status.textContent = text;
    parts.root.classList.toggle("epypes-stale", failure !== null);
  }

  /** @param {Frame} frame */
  function describe(frame) {
    parts.root.classList.remove("epypes-empty");
    parts.token.textContent = frame.token;
    parts.kind.textContent = frame.shape ? `${frame.dtype} ${frame.shape}` : "";
    parts.functions.textContent = `${frame.ran} ran, ${frame.reused} reused`;
    parts.functions.title = Object.entries(frame.times_ms)
      .map(([name, ms]) => `${name}: ${inMs(ms)}`)
      .join("\n");
    tellTimes(frame.compute_ms, frame.to_screen_ms);
    if (failure && !frame.stale && failure.seq < frame.seq) failure = null;
    tellFailure();
  }

  /**
   * Decode off screen, then swap, so that the old picture stays until the new one is whole.
   * @param {Frame} frame
   * @param {DataView | undefined} buffer
   */
  async function showPicture(frame, buffer) {
    const next = URL.createObjectURL(new Blob(buffer ? [buffer] : [], { type: frame.media_type }));
    const decoded = new Image();
    decoded.src = next;
    try {
      await decoded.decode();
    } catch {
      URL.revokeObjectURL(next);
      parts.status.textContent = `The picture of ${frame.token} can't be decoded (${frame.media_type}).`;
      return;
    }
    if (frame.seq < received) {
      URL.revokeObjectURL(next); // overtaken while it was decoded
      return;
    }
    const old = url;
    url = next;
    parts.img.src = url;
    await parts.img.decode().catch(() => undefined);
    if (url !== next) return;
    parts.img.alt = alternative(frame);
    parts.img.hidden = false;
    parts.text.hidden = true;
    parts.img.dataset.seq = String(frame.seq);
    parts.img.dataset.values = JSON.stringify(frame.values);
    if (old) URL.revokeObjectURL(old);
    describe(frame);
  }

  /** @param {Frame} frame */
  function showText(frame) {
    parts.text.textContent = frame.text ?? "";
    parts.text.dataset.seq = String(frame.seq);
    parts.text.dataset.values = JSON.stringify(frame.values);
    parts.img.hidden = true;
    parts.text.hidden = false;
    describe(frame);
  }

  /**
   * @param {Frame} frame
   * @param {DataView[]} buffers
   */
  async function onFrame(frame, buffers) {
    // Sent again because another view of this panel was mounted.
    if (frame.seq > painted) {
      received = Math.max(received, frame.seq);
      if (frame.media_type === "text/plain") showText(frame);
      else await showPicture(frame, buffers[0]);
      await nextPaint();
      painted = Math.max(painted, frame.seq);
    }
    model.send({ kind: "painted", seq: frame.seq });
  }

  /**
   * @param {Frame | Failure | Latency} message
   * @param {DataView[]} buffers
   */
  function onMessage(message, buffers) {
    if (message.kind === "frame") {
      onFrame(message, buffers);
    } else if (message.kind === "error") {
      failure = message;
      tellFailure();
    } else if (message.kind === "latency") {
      tellTimes(Number(parts.times.dataset.compute ?? 0), message.to_screen_ms);
    }
  }

  model.on("msg:custom", onMessage);
  model.send({ kind: "ready" });
  return () => {
    model.off("msg:custom", onMessage);
    if (url) URL.revokeObjectURL(url);
  };
}

export default { render };
