// Keypoints, contours and boxes above a picture.
import { note, shape } from "./elements.js";

const LEAST_RADIUS = 2;
/** Two strokes, dark under bright, can be seen on any picture. */
const LAYERS = [
  ["epypes-halo", "lines"],
  ["epypes-halo epypes-dots", "dots"],
  ["epypes-mark-line", "lines"],
  ["epypes-mark-line epypes-dots", "dots"],
];

/** Return a point as a circle of its size with a radius that shows its angle; a dot for one without size. */
export function pointPath([x, y, size, angle]) {
  const at = (number) => Number(number.toFixed(2));
  if (!(size > 0)) return `M${at(x)} ${at(y)}h0`;
  const radius = Math.max(size / 2, LEAST_RADIUS);
  const half = (along) => `a${at(radius)} ${at(radius)} 0 1 0 ${at(along)} 0`;
  const circle = `M${at(x - radius)} ${at(y)}${half(2 * radius)}${half(-2 * radius)}`;
  if (!(angle >= 0)) return circle;
  const turned = (angle * Math.PI) / 180;
  return `${circle}M${at(x)} ${at(y)}l${at(radius * Math.cos(turned))} ${at(radius * Math.sin(turned))}`;
}

/** Return a line of flat coordinates as a path. */
export function linePath(line, isClosed) {
  let path = "";
  for (let i = 0; i + 1 < line.length; i += 2) path += `${i ? "L" : "M"}${line[i]} ${line[i + 1]}`;
  return path && isClosed ? `${path}Z` : path;
}

/** Return a drawing above a picture. */
export function overlaySvg() {
  const layers = LAYERS.map(([name]) => shape("path", { class: name }));
  return shape("svg", { class: "epypes-overlay", preserveAspectRatio: "none", "aria-hidden": "true" }, ...layers);
}

/** Draw marks, or take away those of the frame before. The first pixel of the picture reaches from 0 to 1. */
export function drawOverlay(svg, overlay) {
  const points = overlay?.points ?? [];
  const lines = (overlay?.lines ?? []).map((line) => linePath(line, overlay.closed));
  const paths = {
    dots: points.filter(([, , size]) => !(size > 0)).map(pointPath).join(""),
    lines: points.filter(([, , size]) => size > 0).map(pointPath).join("") + lines.join(""),
  };
  LAYERS.forEach(([, kind], at) => note(svg.children[at], "d", paths[kind]));
}

/** Return how many marks there are, and how many of them are drawn if not all. */
export function overlayCount(overlay) {
  if (!overlay) return "";
  const drawn = overlay.points.length + overlay.lines.length;
  return `${overlay.total} ${overlay.what}${drawn < overlay.total ? ` (${drawn} drawn)` : ""}`;
}
