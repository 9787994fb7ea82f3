// Frames: shown one after the other, the newest next, and acknowledged.
import { written } from "./numbers.js";
import { drawOverlay } from "./overlay.js";
import { newestNext } from "./protocol.js";

/** The URL of what an image shows, revoked when it shows something else. */
const shownUrls = new WeakMap();

/**
 * Show bytes in an image in place of those before, which stay until these have been loaded. Resolves when the next paint
 * has them: with whether they are shown, which they are not if newer ones came, or if they are no picture.
 */
export function swap(img, bytes, type) {
  const url = URL.createObjectURL(new Blob([bytes], { type }));
  return new Promise((resolve) => {
    const over = new AbortController();
    const end = (event) => {
      over.abort();
      const isShown = img.src === url && event.type === "load";
      if (isShown) clear(img, url);
      else URL.revokeObjectURL(url);
      if (img.src === url && !isShown) img.src = shownUrls.get(img) ?? "";
      resolve(isShown);
    };
    for (const type of ["load", "error"]) img.addEventListener(type, end, { signal: over.signal });
    img.src = url;
  });
}

/** Give back the bytes that an image shows, for other ones or for none. */
export function clear(img, url = "") {
  URL.revokeObjectURL(shownUrls.get(img) ?? "");
  shownUrls.set(img, url);
  if (!url) img.removeAttribute("src");
}

/** Pictures with the bytes that came for them, in order; texts have none. */
export function withBytes(pictures, buffers) {
  let next = 0;
  return pictures.map((picture) => ({ picture, bytes: picture.media_type.startsWith("image/") ? buffers[next++] : undefined }));
}

/** What failed, as long as no better frame has come. */
export function failures() {
  let good = 0;
  /** @type {null | {seq: number, text: string, function?: string, names?: string[]}} */
  let failure = null;
  return {
    /** A frame is on the screen. */
    paint(frame) {
      if (!frame.stale) good = Math.max(good, frame.seq);
      if (failure && failure.seq < good) failure = null;
    },
    /** An error has come: it counts if neither a better frame nor a later error has. An empty one ends it. */
    fail(error) {
      if (error.seq > good && error.seq >= (failure?.seq ?? 0)) failure = error.text ? error : null;
    },
    get failure() { return failure; },
  };
}

/** Shows frames, and writes down what they say beside their picture afterwards, by `panel.describe`. */
export function framesPart(panel, stage, tiles, failed) {
  let newest = 0;
  let acknowledged = 0;

  function mark(node, frame) {
    node.dataset.seq = String(frame.seq);
    node.dataset.values = JSON.stringify(frame.values);
    tiles.show(frame);
    stage.text.hidden = node !== stage.text;
    stage.canvas.hidden = node === stage.text;
  }

  async function showPicture(frame, { picture, bytes }, under) {
    // What it is compared with lies over the same image.
    const beneath = under?.bytes ? [stage.under, ...(panel.compare.target ? [stage.otherUnder] : [])] : [];
    const swaps = [swap(stage.picture, bytes, picture.media_type), ...beneath.map((img) => swap(img, under.bytes, under.picture.media_type))];
    if (!(await swaps[0])) throw new Error(`its bytes are no ${picture.media_type}`);
    await Promise.all(swaps);
    for (const img of [stage.under, stage.otherUnder]) {
      if (beneath.includes(img)) panel.dress(img, under.picture);
      else clear(img);
    }
    panel.dress(stage.picture, picture, beneath.length > 0);
    const values = Object.entries(frame.values).map(([name, value]) => `${name} ${typeof value === "number" ? written(value) : value}`);
    stage.picture.alt = `${frame.token}${values.length ? ` with ${values.join(", ")}` : ""}`;
    stage.picture.hidden = false;
    stage.resize(picture.full_width ?? picture.width, picture.full_height ?? picture.height);
    drawOverlay(stage.overlay, picture.overlay);
    mark(stage.picture, frame);
  }

  async function show({ frame, buffers }) {
    const began_ms = performance.now();
    acknowledged = frame.seq;
    panel.painted(frame.seq);
    const shown = withBytes(frame.pictures, buffers);
    const main = shown.find(({ picture }) => picture.role === "main") ?? shown[0];
    const other = shown.find(({ picture }) => picture.role === "other");
    const under = shown.find(({ picture }) => picture.role === "under");
    try {
      const compared = other && panel.compare.take(other.picture, other.bytes, frame.seq);
      if (main.picture.media_type === "text/plain") {
        stage.text.textContent = main.picture.text ?? "";
        mark(stage.text, frame);
      } else await showPicture(frame, main, under);
      await compared;
      failed.paint(frame);
      panel.describe({ frame, main: main.picture, shown });
    } catch (error) {
      panel.tell(`The picture of ${frame.token} can't be shown: ${error.message}.`, true);
    }
    panel.took(performance.now() - began_ms);
  }

  const next = newestNext(show);
  return {
    /** A frame that is late, or comes again, is acknowledged only; one that waits, when its turn comes. */
    take(frame, buffers) {
      if (frame.seq > newest) {
        newest = frame.seq;
        next({ frame, buffers });
      } else if (frame.seq < newest || acknowledged === newest) panel.painted(frame.seq);
    },
  };
}
