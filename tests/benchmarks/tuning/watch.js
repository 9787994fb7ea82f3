// When was a slider moved, and when did the page show what came of it?
//
// window.bench.watch(name, cell, label, shows) follows the slider with that label in a cell, and the pictures that
// `shows` announces; window.bench.take(name) gives what was seen since, and forgets it.
(() => {
  const KEPT = 64;
  const blobs = new Map();
  const create = URL.createObjectURL.bind(URL);
  URL.createObjectURL = (blob) => {
    const url = create(blob);
    blobs.set(url, blob);
    if (blobs.size > KEPT) blobs.delete(blobs.keys().next().value);
    return url;
  };

  const seen = {};

  /** How each contender says which value a picture shows; `shown(value)` is called when it stands in the page. */
  const SHOWS = {
    panel(root, label, shown) {
      const img = root.querySelector("img.epypes-picture");
      new MutationObserver(() => shown(JSON.parse(img.dataset.values)[label])).observe(img, {
        attributeFilter: ["data-values"],
      });
    },
    // The value stands in the last bytes of the picture, behind its end.
    blob(root, label, shown) {
      whenDecoded(root, (img) => blobs.get(img.src)?.slice(-3).text(), shown);
    },
    // The value stands in the title that the file carries.
    png(root, label, shown) {
      whenDecoded(root, (img) => /Title\0(\d+)/.exec(atob(img.src.split(",")[1]))?.[1], shown);
    },
  };

  /** A picture that has been loaded is not on the screen: the panel's are decoded, too, before they are announced. */
  function whenDecoded(root, value, shown) {
    const onLoad = async ({ target }) => {
      const read = value(target);
      try {
        await target.decode();
      } catch {
        return; // replaced before it could be seen
      }
      shown(Number(await read));
    };
    root.addEventListener("load", onLoad, true);
  }

  window.bench = {
    watch(name, cell, label, kind) {
      const root = document.querySelectorAll(".jp-Notebook .jp-Cell")[cell];
      const slider = [...root.querySelectorAll(".widget-slider")].find((each) => each.textContent.includes(label));
      const handle = slider.querySelector(".noUi-handle");
      const value = () => Number(handle.getAttribute("aria-valuenow"));
      const entry = { moves: [], pictures: [], value };
      seen[name] = entry;
      new MutationObserver(() => entry.moves.push([performance.now(), value()])).observe(handle, {
        attributeFilter: ["aria-valuenow"],
      });
      SHOWS[kind](root, label, (value) => {
        requestAnimationFrame(() => entry.pictures.push([performance.now(), value]));
      });
    },
    /** Resolves when the last picture shows the value that the slider has; false if that takes too long. */
    settled(name, timeout) {
      const entry = seen[name];
      const isSettled = () => entry.pictures.at(-1)?.[1] === entry.value();
      return new Promise((resolve) => {
        const timer = setInterval(() => isSettled() && done(true), 4);
        const limit = setTimeout(() => done(false), timeout);
        function done(result) {
          clearInterval(timer);
          clearTimeout(limit);
          resolve(result);
        }
      });
    },
    take(name) {
      const { moves, pictures } = seen[name];
      seen[name].moves = [];
      seen[name].pictures = pictures.slice(-1);
      return { moves, pictures };
    },
  };
})();
