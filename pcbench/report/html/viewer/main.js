// Connect the page's form controls with the scene and draw it when something changes.

const byId = (id) => document.getElementById(id);

function start() {
  const data = JSON.parse(byId("view-data").textContent);
  if (!data.layers.length) return;
  const payloads = data.layers.map((_, k) => byId(`layer-${k}`).textContent.trim());
  const scene = new Scene(data, payloads);
  const camera = new Camera();
  camera.sceneRadius = scene.radius;
  let canvas = byId("canvas");
  let renderer;
  try {
    if (new URLSearchParams(location.search).has("painter")) throw new Error("asked for");
    renderer = new WebglRenderer(canvas);
  } catch {
    const fresh = canvas.cloneNode(); // a canvas keeps its first kind of context
    canvas.replaceWith(fresh);
    canvas = fresh;
    renderer = new Painter(canvas);
    byId("renderer-note").hidden = false;
    byId("lighting").disabled = true;
  }
  const report = { scene, camera, renderer, firstPictureMs: null };
  window.pcbenchReport = report;
  const page = new ViewPage(report, canvas);
  report.draw = () => page.draw();
  report.pick = (x, y) => page.pick(x, y);
  report.ready = page.show(scene.first());
}

class ViewPage {
  constructor(report, canvas) {
    Object.assign(this, { report, canvas, scene: report.scene, camera: report.camera, marked: null, waiting: false });
    this.scene.views.forEach((view, k) => {
      if (view.name) view.color = rgb(this.scene.data.series[k % this.scene.data.series.length]);
    });
    this.connectViews();
    this.connectLegend();
    this.connectClip();
    this.connectPlaces();
    this.connectOptions();
    control(canvas, this.camera, (key) => this.key(key), () => this.later(), (x, y) => this.pick(x, y));
    this.fit();
    new ResizeObserver(() => this.later()).observe(canvas);
    window.addEventListener("beforeprint", () => this.draw());
    // A browser takes the GPU away from pages in the background, and gives it back without their data.
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      report.renderer = new WebglRenderer(canvas);
      this.draw();
    });
  }

  // Draw once before the next frame, however often this is called.
  later() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const { canvas, scene } = this;
    const size = [Math.max(1, Math.round(canvas.clientWidth * ratio)), Math.max(1, Math.round(canvas.clientHeight * ratio))];
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    scene.pixelRatio = ratio;
    this.report.renderer.draw(scene, this.camera);
    this.placeMarker();
    if (this.report.firstPictureMs === null && scene.visible().length) {
      this.report.renderer.pixel(0, 0); // waits for the picture
      this.report.firstPictureMs = performance.now(); // since the page began to load
    }
  }

  async show(view) {
    this.scene.showOnly(view);
    await this.refresh();
  }

  // Bring the controls and the picture up to date with the scene.
  async refresh() {
    await this.scene.load();
    this.scene.views.forEach((view, k) => (byId(`view-${k}`).checked = view.on));
    byId("scalar").value = this.scene.key;
    this.showLegend();
    this.draw();
  }

  connectViews() {
    this.scene.views.forEach((view, k) => {
      byId(`view-${k}`).addEventListener("change", (event) => {
        view.on = event.target.checked;
        this.refresh();
      });
      byId(`only-${k}`).addEventListener("click", () => this.show(view));
    });
  }

  connectLegend() {
    byId("scalar").addEventListener("change", (event) => {
      this.scene.key = event.target.value;
      this.refresh();
    });
    const [low, high] = [byId("legend-low"), byId("legend-high")];
    const set = (changed) => {
      const legend = this.scene.legend();
      if (!legend) return;
      const value = Number(changed.value);
      const ends = legend.signed
        ? { low: -Math.abs(value), high: Math.abs(value) }
        : { low: Number(low.value), high: Number(high.value) };
      if (ends.high > ends.low) this.scene.limits.set(this.scene.key, ends);
      this.refresh();
    };
    for (const input of [low, high]) input.addEventListener("change", () => set(input));
    byId("legend-reset").addEventListener("click", () => {
      this.scene.limits.delete(this.scene.key);
      this.refresh();
    });
  }

  showLegend() {
    const { scene } = this;
    const legend = scene.legend();
    byId("legend").hidden = !legend;
    if (!legend) return;
    const steps = Array.from({ length: 17 }, (_, k) => legend.low + (k / 16) * (legend.high - legend.low));
    const colors = steps.map((value) => `rgb(${scene.color(value, legend)})`);
    byId("legend-bar").style.background = `linear-gradient(to right, ${colors})`;
    byId("legend-low").value = short(legend.low);
    byId("legend-high").value = short(legend.high);
    byId("legend-note").textContent = legend.note;
    byId("legend-reset").hidden = !scene.limits.has(scene.key);
  }

  connectClip() {
    const { scene } = this;
    const { low, high } = scene.box;
    [0, 1, 2].forEach((axis) => {
      const inputs = ["low", "high"].map((end) => byId(`clip-${end}-${axis}`));
      const output = byId(`clip-text-${axis}`);
      const set = () => {
        const ends = inputs.map((input) => low[axis] + (input.value / 1000) * (high[axis] - low[axis]));
        scene.clip.low[axis] = Math.min(...ends);
        scene.clip.high[axis] = Math.max(...ends);
        const shown = [scene.clip.low[axis], scene.clip.high[axis]].map((x) => rounded(x + scene.center[axis]));
        output.textContent = `${shown[0]} to ${shown[1]}`;
        this.later();
      };
      for (const input of inputs) input.addEventListener("input", set);
      set();
    });
    byId("clip-reset").addEventListener("click", () => {
      for (const axis of [0, 1, 2]) {
        for (const [end, value] of [["low", 0], ["high", 1000]]) {
          const input = byId(`clip-${end}-${axis}`);
          input.value = value;
          input.dispatchEvent(new Event("input"));
        }
      }
    });
  }

  connectPlaces() {
    this.scene.data.places.forEach((place, k) => {
      byId(`place-${k}`).addEventListener("click", () => this.flyTo(place));
    });
  }

  connectOptions() {
    const { scene } = this;
    byId("lighting").addEventListener("change", (event) => {
      scene.lighting = event.target.checked;
      this.later();
    });
    byId("point-size").addEventListener("input", (event) => {
      scene.pointSize = 2 ** Number(event.target.value);
      this.later();
    });
    byId("reset-view").addEventListener("click", () => this.resetView());
    byId("top-view").addEventListener("click", () => this.key("t") && this.later());
    const arrows = byId("arrows");
    if (!arrows) return;
    const useful = scene.usefulExaggeration();
    const slider = byId("exaggeration");
    const set = () => {
      const factor = useful * 10 ** Number(slider.value);
      scene.exaggeration = arrows.checked ? factor : 0;
      byId("exaggeration-text").textContent = `× ${Number(factor.toPrecision(2))}`;
      this.later();
    };
    arrows.addEventListener("change", set);
    slider.addEventListener("input", set);
    set();
  }

  resetView() {
    Object.assign(this.camera, { yaw: -0.6, pitch: 0.75 });
    this.fit();
    this.later();
  }

  fit() {
    this.camera.fit(this.scene.core.low, this.scene.core.high, this.canvas.clientWidth / this.canvas.clientHeight);
  }

  // Act on a key of the view and return whether it has a meaning.
  key(key) {
    const { camera, scene } = this;
    const sides = { t: [0, Math.PI / 2], f: [0, 0.05], s: [-Math.PI / 2, 0.05] };
    if (sides[key]) {
      [camera.yaw, camera.pitch] = sides[key];
      this.fit();
    }
    else if (key === "r") this.resetView();
    else if (key === "l") byId("lighting").click();
    else if (/^[1-9]$/.test(key) && scene.views[key - 1]) this.show(scene.views[key - 1]);
    else return false;
    return true;
  }

  async flyTo(place) {
    const view = this.scene.views.find((view) => view.name === place.layer && view.of === place.of);
    if (view && !view.on) await this.show(view);
    this.mark(place.at, `${place.candidate}, ${place.what}: ${place.size}`);
    byId("view").scrollIntoView({ block: "nearest" });
    const from = { target: this.camera.target, distance: this.camera.distance };
    const to = { target: this.scene.local(place.at), distance: 4 * place.radius };
    const duration = matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 500;
    const begun = performance.now();
    const step = () => {
      const share = duration ? Math.min(1, (performance.now() - begun) / duration) : 1;
      const eased = share * share * (3 - 2 * share);
      this.camera.target = from.target.map((x, k) => x + eased * (to.target[k] - x));
      this.camera.distance = from.distance * (to.distance / from.distance) ** eased;
      this.draw();
      if (share < 1) requestAnimationFrame(step);
    };
    step();
  }

  // Mark the point under a pixel, and return it.
  pick(x, y) {
    const ratio = this.scene.pixelRatio;
    const found = this.scene.pick(x * ratio, y * ratio, this.camera, this.canvas.width, this.canvas.height);
    if (!found) {
      this.mark(null, "No point here.");
      return null;
    }
    const { unit } = this.scene.data;
    const coarsest = Math.max(...found.view.layer.head.step) || 1e-3; // more digits than the grid has would be invented
    const decimals = Math.min(9, Math.max(0, Math.round(-Math.log10(coarsest))));
    const position = found.at.map((value) => value.toFixed(decimals)).join(", ");
    const values = found.scalars.map(({ key, value }) => {
      const text = value === undefined ? "unknown" : `${Number(value.toPrecision(3))}${unit ? ` ${unit}` : ""}`;
      return `${key.replaceAll("_", " ")} ${text}`;
    });
    const whose = found.view.name || `reference, to ${found.view.of}`;
    this.mark(found.at, `${whose} at (${position}): ${values.join(", ")}`);
    return found;
  }

  mark(at, text) {
    this.marked = at;
    byId("picked").textContent = text;
    byId("picked").classList.toggle("found", Boolean(at));
    this.placeMarker();
  }

  placeMarker() {
    const marker = byId("marker");
    const { canvas, marked } = this;
    const spot = marked && this.camera.project(this.scene.local(marked), canvas.clientWidth, canvas.clientHeight);
    const inside = spot && spot[0] >= 0 && spot[1] >= 0 && spot[0] <= canvas.clientWidth && spot[1] <= canvas.clientHeight;
    marker.hidden = !inside;
    if (inside) marker.style.transform = `translate(${spot[0]}px, ${spot[1]}px)`;
  }
}

function short(value) {
  return Number(value.toPrecision(4)).toString();
}

function rounded(value) {
  return value.toFixed(Math.abs(value) < 10 ? 2 : 1);
}

function rgb(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
}

start();
