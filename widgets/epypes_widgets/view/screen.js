// How does a frame get to the screen, whole and in time?
import { decoded } from "./blobs.js";
import { written } from "./numbers.js";
import { drawOverlay } from "./overlay.js";

function alternative(frame) {
  const values = Object.entries(frame.values).map(([name, value]) => `${name} ${typeof value === "number" ? written(value) : value}`);
  return `${frame.token}${values.length ? ` with ${values.join(", ")}` : ""}`;
}

/** Pictures with the bytes that came for them, in order; texts have none. */
export function withBytes(pictures, buffers) {
  let next = 0;
  return pictures.map((picture) => ({
    picture,
    bytes: picture.media_type.startsWith("image/") ? buffers[next++] : undefined,
  }));
}

/**
 * Shows frames: decodes off the screen, swaps, and says so: the browser paints it next. What a frame says beside its picture
 * is written down afterwards, by `panel.later`.
 */
export function screen(panel, stage, arrivals) {
  function mark(node, frame) {
    node.dataset.seq = String(frame.seq);
    node.dataset.values = JSON.stringify(frame.values);
  }

  function showText(frame, picture) {
    stage.text.textContent = picture.text ?? "";
    mark(stage.text, frame);
    stage.text.hidden = false;
    stage.canvas.hidden = true;
  }

  async function showPicture(frame, { picture, bytes }, other) {
    const url = panel.blobs.open(bytes, picture.media_type);
    const [main] = await Promise.all([decoded(url), other]);
    if (!main || arrivals.isOvertaken(frame.seq)) {
      panel.blobs.close(url);
      if (!main) throw new Error(`its bytes are no ${picture.media_type}`);
      return;
    }
    stage.picture.src = url;
    await stage.picture.decode().catch(() => undefined);
    if (stage.picture.src !== url) return panel.blobs.close(url);
    panel.blobs.put(stage.picture, url);
    stage.picture.alt = alternative(frame);
    stage.picture.hidden = stage.canvas.hidden = false;
    stage.text.hidden = true;
    stage.resize(picture.full_width ?? picture.width, picture.full_height ?? picture.height);
    drawOverlay(stage.overlay, picture.overlay);
    mark(stage.picture, frame);
  }

  async function show(frame, buffers) {
    const shown = withBytes(frame.pictures, buffers);
    const main = shown.find(({ picture }) => picture.role === "main") ?? shown[0];
    const other = shown.find(({ picture }) => picture.role === "other");
    const compared = other ? panel.compare.take(other.picture, other.bytes, frame.seq) : undefined;
    if (main.picture.media_type === "text/plain") showText(frame, main.picture);
    else await showPicture(frame, main, compared);
    if (arrivals.isOvertaken(frame.seq)) return;
    arrivals.paint(frame);
    panel.later({ frame, main: main.picture, shown });
  }

  /** The number of the frame that is being decoded, which has been acknowledged; none if it is 0. */
  let shown = 0;
  /** What came meanwhile. */
  let next = null;

  /** Show a frame, and then the newest of those that came meanwhile. */
  async function showAll(...first) {
    for (let given = first; given; [given, next] = [next, null]) {
      const [frame, buffers] = given;
      const began_ms = performance.now();
      shown = frame.seq;
      panel.painted(frame.seq);
      try {
        await show(frame, buffers);
      } catch (error) {
        arrivals.lose(frame.seq);
        panel.tell(`The picture of ${frame.token} can't be shown: ${error.message}.`, true);
      }
      panel.took(performance.now() - began_ms);
    }
    shown = 0;
  }

  return {
    take(frame, buffers) {
      const todo = arrivals.frame(frame.seq);
      if (todo === "acknowledge" || frame.seq === shown) panel.painted(frame.seq);
      else if (todo === "show" && shown) next = [frame, buffers];
      else if (todo === "show") showAll(frame, buffers);
    },
  };
}
