// How much room the picture has: a handle below it, and the full width of the panel.
import { consume, element, follow, iconButton, note } from "./elements.js";

const LEAST_HEIGHT_PX = 160;
const HEIGHT_STEP_PX = 20;
const HEIGHT_KEY = "epypes-picture-height";
const BIGGER = { ArrowDown: 1, ArrowUp: -1 };

/** The heights that a user has given to pictures are remembered in the browser, where that is allowed. */
function rememberedHeight(height_px) {
  try {
    if (height_px === undefined) return Number(localStorage.getItem(HEIGHT_KEY));
    localStorage.setItem(HEIGHT_KEY, height_px);
  } catch {
    // It is then the usual height next time.
  }
  return height_px;
}

export function sizePart(figure, box) {
  const label = "Height of the picture: drag, or use the arrow keys; double-click for the usual one";
  const handle = element("div", "epypes-resize", { role: "separator", tabindex: "0", "aria-orientation": "horizontal", "aria-label": label, title: label });
  const wide = iconButton("wide", "Full width: the controls above the picture", toggle, "epypes-full-width");

  function resize(height_px) {
    const height = height_px ? Math.max(LEAST_HEIGHT_PX, Math.round(height_px)) : 0;
    box.style.height = height ? `${height}px` : "";
    return height;
  }

  function toggle() {
    const isWide = figure.closest(".epypes-panel")?.classList.toggle("epypes-wide");
    note(wide, "aria-pressed", Boolean(isWide));
  }

  follow(handle, ({ clientY }) => {
    const before_px = box.offsetHeight;
    return {
      move: (event) => resize(before_px + event.clientY - clientY),
      end: () => rememberedHeight(box.offsetHeight),
    };
  });
  handle.addEventListener("dblclick", () => rememberedHeight(resize(0)));
  handle.addEventListener("keydown", (event) => {
    const steps = BIGGER[event.key];
    if (!steps) return;
    consume(event);
    rememberedHeight(resize(box.offsetHeight + steps * HEIGHT_STEP_PX));
  });
  resize(rememberedHeight());
  return { handle, wide };
}
