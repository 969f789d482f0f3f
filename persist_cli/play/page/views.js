// The imagined views, one pane for each memory, and the figures below them.

const SHOWN = 200; // the frames and keys of which the 95th percentile is told
const FEW = 10; // frames whose mean is told: those of a clip are imagined together
const PAUSE = 1000; // milliseconds without a frame that are no part of frames a second
const CAPTION = 30; // pixels around a view: its name and the gap

class Views {
  constructor() {
    this.stage = byId("stage");
    this.panes = byId("panes");
    this.canvases = [];
    new ResizeObserver(() => this.fit()).observe(byId("view"));
    addEventListener("resize", () => this.fit());
  }

  begin(memories, [width, height]) {
    this.size = [width, height];
    const panes = memories.map(memory => {
      const canvas = make("canvas", { width, height });
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `What is imagined with ${memoryName(memory)}`);
      canvas.dataset.memory = memory;
      const pane = make("figure");
      pane.append(canvas, make("figcaption", { textContent: memoryName(memory) }));
      return pane;
    });
    this.panes.replaceChildren(...panes);
    this.canvases = [...this.panes.querySelectorAll("canvas")];
    this.fit();
  }

  draw(header, images) {
    images.forEach((image, number) => drawImage(this.canvases[number], image));
    this.stage.dataset.number = header.number;
    this.stage.classList.toggle("blocked", !header.free);
  }

  // As large as all panes fit together, each pixel of a view as a square of whole pixels of the screen
  // where that costs little.
  fit() {
    if (!this.canvases.length) return;
    const [width, height] = this.size, wide = matchMedia("(min-width: 60rem)").matches;
    const around = byId("figures").offsetHeight + byId("view").parentElement.offsetTop + 48;
    const most = wide ? innerHeight - around : 0.58 * innerHeight;
    const across = this.stage.clientWidth - 14;
    let scale = 0;
    for (let columns = this.canvases.length; columns; columns--) { // side by side, unless rows are clearly larger
      const rows = Math.ceil(this.canvases.length / columns);
      const fits = Math.min((across - 7 * (columns - 1)) / columns / width, (most / rows - CAPTION) / height);
      if (fits > 1.3 * scale) scale = fits;
    }
    const dots = scale * devicePixelRatio, whole = Math.floor(dots);
    if (whole > 0.85 * dots) scale = whole / devicePixelRatio;
    scale = Math.max(scale, 96 / width);
    for (const canvas of this.canvases) {
      canvas.style.width = `${scale * width}px`;
      canvas.style.height = `${scale * height}px`;
      canvas.style.imageRendering = dots >= 1 ? "pixelated" : "auto";
    }
  }
}

class Figures {
  constructor() {
    this.forget();
  }

  forget() {
    Object.assign(this, { drawn: [], frames: [], keys: [], waiting: null, number: -1 });
  }

  // A key was pressed while nothing was held: its picture is the next one with its action.
  press(action, at) {
    this.waiting = { action, at, after: this.number };
  }

  frame({ number, action, pose, milliseconds }) {
    this.number = number;
    byId("number").textContent = number;
    byId("place").textContent = `${pose.x.toFixed(2)}, ${pose.y.toFixed(2)} m, ${Math.round(pose.degrees)}°`;
    if (action === null) return;
    this.frames = [...this.frames, milliseconds].slice(-SHOWN);
    show("frame", mean(this.frames.slice(-FEW)), this.frames);
    this.rate(performance.now());
    const { waiting } = this;
    if (!waiting || waiting.action !== action || number <= waiting.after) return;
    this.waiting = null;
    requestAnimationFrame(() => this.answered(waiting.at)); // it is painted with this frame of the screen
  }

  answered(start) {
    const { duration } = performance.measure("key to picture", { start, end: performance.now() });
    performance.clearMeasures("key to picture"); // observers have it; the browser would keep all of them
    this.keys = [...this.keys, duration].slice(-SHOWN);
    show("key", duration, this.keys);
  }

  rate(now) {
    if (now - this.drawn.at(-1) > PAUSE) this.drawn = [];
    this.drawn = [...this.drawn, now].slice(-20);
    const seconds = (now - this.drawn[0]) / 1000;
    if (this.drawn.length > 3) byId("rate").textContent = ((this.drawn.length - 1) / seconds).toFixed(1);
  }
}

// Show a duration, and the 95th percentile of those that count.
function show(name, duration, durations) {
  const sorted = [...durations].sort((a, b) => a - b);
  byId(`last-${name}`).textContent = Math.round(duration);
  byId(`slow-${name}`).textContent = Math.round(sorted[Math.ceil(0.95 * sorted.length) - 1]);
}

function mean(numbers) {
  return numbers.reduce((sum, number) => sum + number, 0) / numbers.length;
}

function drawImage(canvas, image) {
  if (canvas.width !== image.width || canvas.height !== image.height) Object.assign(canvas, { width: image.width, height: image.height });
  canvas.getContext("2d").drawImage(image, 0, 0);
  image.close();
}

function memoryName(memory) {
  return { none: "no memory", stage1: "stage 1, without an adapter" }[memory] ?? `memory: ${memory}`;
}

function byId(id) {
  return document.getElementById(id);
}
