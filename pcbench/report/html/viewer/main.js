// Connect the page's form controls with the scene and draw it when something changes.

const byId = (id) => document.getElementById(id);

const PREVIEW_POINTS = 30_000;

async function start() {
  const data = JSON.parse(byId("view-data").textContent);
  const scene = new Scene(data, data.layers.map((_, k) => byId(`layer-${k}`).textContent.trim()));
  const camera = new Camera(scene.up);
  camera.sceneRadius = scene.radius;
  camera.reach = Math.max(3 * scene.radius, ...scene.cameraCenters().map((at) => 1.1 * Math.hypot(...at)));
  if (data.isWall) camera.startBefore(data.axes);
  else if (data.cameras && data.up) camera.startAlong(data.cameras.directions);
  const report = { scene, camera, renderer: null, page: null, firstPictureMs: null, allPointsMs: null };
  window.pcbenchReport = report;
  report.ready = open(report);
}

// Show the first picture: at once some of its points, because a browser may take a second to start WebGL, then all.
async function open(report) {
  const { scene, camera } = report;
  scene.showOnly(scene.first());
  await scene.load();
  const canvas = byId("canvas");
  camera.fit(scene.framed(), canvas.clientWidth / canvas.clientHeight);
  const preview = paintPreview(scene, camera, canvas);
  await nextFrame();
  report.firstPictureMs = performance.now(); // since the page began to load
  report.page = new ViewPage(report, rendererFor(report, canvas));
  await report.page.refresh();
  preview.remove(); // the browser shows both changes at once
  await report.renderer.finished();
  report.allPointsMs = performance.now();
}

// Paint some points over the canvas, at half its resolution, and return the element.
function paintPreview(scene, camera, canvas) {
  const preview = document.createElement("canvas");
  preview.className = "preview";
  [preview.width, preview.height] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, x >> 1));
  const stride = Math.ceil(scene.visible()[0].layer.head.shown / PREVIEW_POINTS);
  new Painter(preview).draw(scene, camera, panesOf(scene, preview.width, preview.height), stride);
  canvas.after(preview);
  return preview;
}

// Set the renderer of a report, and return its canvas.
function rendererFor(report, canvas) {
  try {
    if (new URLSearchParams(location.search).has("painter")) throw new Error("asked for");
    report.renderer = new WebglRenderer(canvas);
    return canvas;
  } catch {
    const fresh = canvas.cloneNode(); // a canvas keeps its first kind of context
    canvas.replaceWith(fresh);
    report.renderer = new Painter(fresh);
    byId("renderer-note").hidden = false;
    byId("lighting").disabled = true;
    return fresh;
  }
}

// Wait until the browser has painted; pages in the background are never painted.
function nextFrame() {
  return new Promise((done) => {
    requestAnimationFrame(() => setTimeout(done));
    setTimeout(done, 200);
  });
}

class ViewPage {
  constructor(report, canvas) {
    Object.assign(this, { report, canvas, scene: report.scene, camera: report.camera, marked: null, waiting: false });
    this.overlay = new Overlay(byId("panes"));
    this.widening = 1; // of the camera's distance, because panes side by side are narrower than the canvas
    this.connectViews();
    this.connectLegend();
    this.connectClip();
    this.connectPlaces();
    this.connectOptions();
    control(canvas, this.camera, {
      paneHeight: () => this.panes[0].height / this.scene.pixelRatio,
      onKey: (key) => this.key(key),
      onChange: () => this.later(),
      onPick: (x, y) => this.pick(x, y),
    });
    new ResizeObserver(() => this.fits() || this.later()).observe(canvas);
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
    this.layOut();
    this.report.renderer.draw(this.scene, this.camera, this.panes);
    this.showMarked();
  }

  // Return the width and height of the canvas on the page, in device pixels.
  sizeOnPage() {
    const { clientWidth, clientHeight } = this.canvas;
    return [clientWidth, clientHeight].map((x) => Math.max(1, Math.round(x * this.scene.pixelRatio)));
  }

  fits() {
    const [width, height] = this.sizeOnPage();
    return this.canvas.width === width && this.canvas.height === height;
  }

  // Adapt the canvas to its size on the page, and divide it into panes.
  layOut() {
    const { canvas, scene, camera } = this;
    scene.pixelRatio = Math.min(2, window.devicePixelRatio || 1);
    if (!this.fits()) [canvas.width, canvas.height] = this.sizeOnPage();
    this.panes = panesOf(scene, canvas.width, canvas.height);
    // Narrower panes show the same width of the scene as one pane would.
    const widening = Math.max(1, canvas.width / canvas.height / aspectOf(this.panes[0]));
    if (widening !== this.widening) camera.zoom(widening / this.widening);
    this.widening = widening;
  }

  async show(view) {
    this.scene.showOnly(view);
    if (this.scene.sideBySide) this.scene.beside(view).on = true;
    await this.refresh();
  }

  // Show each checked cloud in its own pane; one cloud alone gets the reference beside it.
  async setSideBySide(on) {
    const { scene } = this;
    scene.sideBySide = on;
    if (scene.showsCameras) this.fit(); // cameras are far away: each pane would be nearly empty
    byId("view").classList.toggle("split", on);
    const [first, ...others] = scene.views.filter((view) => view.on);
    if (on && first && !others.length) scene.beside(first).on = true;
    await this.refresh();
  }

  // Bring the controls and the picture up to date with the scene.
  async refresh() {
    await this.scene.load();
    this.scene.views.forEach((view, k) => (byId(`view-${k}`).checked = view.on));
    byId("scalar").value = this.scene.key;
    const count = this.scene.visible().length;
    byId("side-by-side").checked = this.scene.sideBySide;
    byId("pane-note").textContent = this.scene.sideBySide && count > MAX_PANES ? `${MAX_PANES} of ${count} clouds` : "";
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
    byId("side-by-side").addEventListener("change", (event) => this.setSideBySide(event.target.checked));
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
    const { places, tiles } = this.scene.data;
    places.forEach((place, k) => byId(`place-${k}`).addEventListener("click", () => this.flyTo(place)));
    tiles?.of.forEach((candidate, k) => {
      const [button, square] = [byId(`tile-${k}`), byId(`tile-map-${k}`)];
      const place = {
        candidate: tiles.names[candidate],
        what: `tile ${k + 1}`,
        size: square.querySelector("title").textContent,
        at: tiles.at.slice(3 * k, 3 * k + 3),
        layer: tiles.names[candidate],
        of: "",
        radius: 0.75 * tiles.size,
      };
      for (const element of [button, square]) element.addEventListener("click", () => this.flyTo(place, place));
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
    byId("cameras")?.addEventListener("change", (event) => {
      scene.showsCameras = event.target.checked;
      this.fit();
      this.later();
    });
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
    Object.assign(this.camera, this.camera.home);
    this.scene.tile = null;
    this.fit();
    this.later();
  }

  fit() {
    this.layOut();
    this.camera.fit(this.scene.framed(), this.canvas.width / this.canvas.height);
    this.camera.zoom(this.widening);
  }

  // Act on a key of the view and return whether it has a meaning.
  key(key) {
    const { camera, scene } = this;
    const sides = { t: [camera.front, Math.PI / 2], f: [camera.front, 0.05], s: [camera.front - Math.PI / 2, 0.05] };
    if (sides[key]) {
      [camera.yaw, camera.pitch] = sides[key];
      this.fit();
    }
    else if (key === "r") this.resetView();
    else if (key === "l") byId("lighting").click();
    else if (key === "b") byId("side-by-side").click();
    else if (/^[1-9]$/.test(key) && scene.views[key - 1]) this.show(scene.views[key - 1]);
    else return false;
    return true;
  }

  // Fly to a place and mark it; a tile is also outlined.
  async flyTo(place, tile = null) {
    this.scene.tile = tile;
    const view = this.scene.views.find((view) => view.name === place.layer && view.of === place.of);
    if (view && !view.on) await this.show(view);
    this.mark(place.at, `${place.candidate}, ${place.what}: ${place.size}`);
    byId("view").scrollIntoView({ block: "nearest" });
    const from = { target: this.camera.target, distance: this.camera.distance };
    const to = { target: this.scene.local(place.at), distance: 4 * place.radius * this.widening };
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
    const [px, py] = [x * this.scene.pixelRatio, y * this.scene.pixelRatio];
    const pane = this.panes.find((pane) => px >= pane.x && py >= pane.y && px < pane.x + pane.width && py < pane.y + pane.height);
    const found = pane && this.scene.pick(px - pane.x, py - pane.y, this.camera, pane);
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
    this.mark(found.at, `${labelOf(found.view)} at (${position}): ${values.join(", ")}`);
    return found;
  }

  mark(at, text) {
    this.marked = at;
    byId("picked").textContent = text;
    byId("picked").classList.toggle("found", Boolean(at));
    this.showMarked();
  }

  showMarked() {
    const { scene, camera, panes, marked, canvas } = this;
    this.overlay.show(scene, camera, panes, marked && scene.local(marked), canvas);
  }
}

function aspectOf({ width, height }) {
  return width / height;
}

function short(value) {
  return Number(value.toPrecision(4)).toString();
}

function rounded(value) {
  return value.toFixed(Math.abs(value) < 10 ? 2 : 1);
}

start();
