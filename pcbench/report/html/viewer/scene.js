// What is shown: layers, their colours and the clipping box. Positions are relative to the scene's centre.

const UNKNOWN_COLOR = [96, 100, 108];
const PLAIN_COLOR = [150, 154, 160]; // of the reference
const PICK_PIXELS = 8;

class Scene {
  constructor(data, payloads) {
    this.data = data;
    this.payloads = payloads;
    this.layers = data.layers.map((head) => ({ head, codes: null, scalars: [] }));
    this.views = this.layers.flatMap((layer) => viewsOf(layer));
    this.views.forEach((view, k) => {
      if (view.name) view.color = rgb(data.series[k % data.series.length]);
    });
    this.up = normalized(data.up || [0, 0, 1]);
    const keys = data.layers.flatMap((head) => head.scalars.map((scalar) => scalar.key));
    this.key = keys.includes("plane_distance") ? "plane_distance" : keys[0]; // it depends less on density
    this.limits = new Map(); // ends of legends that the reader has set, by scalar
    this.lighting = true;
    this.pointSize = 1;
    this.pixelRatio = 1;
    this.sideBySide = false;
    this.exaggeration = 0; // of displacements; 0 hides them
    this.showsCameras = false;
    this.tile = null; // the outlined one
    this.frame();
    this.clip = { low: [...this.box.low], high: [...this.box.high] };
  }

  // Choose the centre and the size of the scene from the inner 98 % of its points.
  frame() {
    const heads = this.data.layers;
    const ends = (end, pick, of) => [0, 1, 2].map((k) => pick(...heads.map((head) => of(head, end)[k])));
    const core = (head, end) => head.core[end]; // along the scene's axes
    const whole = (head, end) => head.low.map((low, k) => low + end * 65535 * head.step[k]);
    const [low, high] = [ends(0, Math.min, core), ends(1, Math.max, core)];
    const half = low.map((l, k) => (high[k] - l) / 2);
    this.radius = Math.hypot(...half) || 1;
    const { axes } = this.data;
    const along = (at) => [0, 1, 2].map((k) => at.reduce((sum, x, axis) => sum + x * axes[axis][k], 0));
    this.center = along(low.map((l, k) => l + half[k]));
    const local = (at) => at.map((x, k) => x - this.center[k]);
    const extremes = heads.flatMap((head) => head.extremes).map(local);
    this.outline = extremes.length ? extremes : [[0, 0, 0]];
    const margin = 1e-6 * this.radius;
    this.box = {
      low: local(ends(0, Math.min, whole)).map((x) => x - margin),
      high: local(ends(1, Math.max, whole)).map((x) => x + margin),
    };
    for (const layer of this.layers) layer.offset = local(layer.head.low);
  }

  // Return the view to start with: the candidate with the most points, or the reference.
  first() {
    const candidates = this.views.filter((view) => view.name);
    const most = Math.max(...candidates.map((view) => view.layer.head.total));
    return candidates.find((view) => view.layer.head.total === most) || this.views[0];
  }

  // Return the positions to fit into the view: the outermost points, with the cameras if they are shown in it.
  framed() {
    return this.showsCameras && !this.sideBySide ? [...this.outline, ...this.cameraCenters()] : this.outline;
  }

  // Return the positions of the cameras, relative to the scene's centre.
  cameraCenters() {
    const { centers } = this.data.cameras || { centers: [] };
    return Array.from({ length: centers.length / 3 }, (_, k) => this.local(centers.slice(3 * k, 3 * k + 3)));
  }

  visible() {
    return this.views.filter((view) => view.on && view.layer.codes);
  }

  // Decode the layers of visible views that are still packed.
  async load() {
    for (const [k, layer] of this.layers.entries()) {
      if (layer.codes || !this.views.some((view) => view.on && view.layer === layer)) continue;
      Object.assign(layer, await decode(layer.head, this.payloads[k]));
    }
  }

  // Return the view to show beside another one: of a candidate the reference by its distance to it, and the reverse.
  beside(view) {
    const others = this.views.filter((other) => !other.name === Boolean(view.name));
    return others.find((other) => (view.name ? other.of === view.name : other.name === view.of)) || others[0] || view;
  }

  // Show one view, with a scalar that it has.
  showOnly(chosen) {
    for (const view of this.views) view.on = view === chosen;
    if (this.key && this.scalarOf(chosen) < 0) this.key = chosen.layer.head.scalars[0].key;
  }

  // Return the index of the scalar that colours a view, or -1.
  scalarOf(view) {
    return view.layer.head.scalars.findIndex((scalar) => scalar.key === this.key && scalar.of === view.of);
  }

  // Return the legend of the chosen scalar: {low, high, signed, note}, or null. The widest range of the drawn views
  // applies to all of them.
  legend() {
    const drawn = drawnViews(this).filter((view) => this.scalarOf(view) >= 0);
    if (!drawn.length) return null;
    const coloring = (view) => view.layer.head.scalars[this.scalarOf(view)];
    const widest = drawn.reduce((a, b) => (coloring(b).high > coloring(a).high ? b : a));
    const { low, high, signed, note } = coloring(widest);
    const set = this.limits.get(this.key);
    if (set) return { ...set, signed, note: "limits set here" };
    const isShared = drawn.every((view) => coloring(view).high === high);
    return { low, high, signed, note: isShared ? note : `the range of ${labelOf(widest)}: ${note}` };
  }

  // Return the diameter of a layer's points at depth 1, and its bounds, in pixels: points cover their spacing.
  pointPixels(layer, height) {
    return {
      size: (1.3 * this.pointSize * layer.head.spacing * height) / (2 * Math.tan(FIELD_OF_VIEW / 2)),
      smallest: 1.6 * this.pixelRatio * this.pointSize,
      largest: 9 * this.pixelRatio * this.pointSize,
    };
  }

  color(value, legend) {
    const table = legend.signed ? this.data.diverging : this.data.sequential;
    const share = Math.min(1, Math.max(0, (value - legend.low) / (legend.high - legend.low)));
    const at = share * (table.length - 1);
    const k = Math.min(table.length - 2, Math.floor(at));
    return table[k].map((channel, c) => Math.round(channel + (at - k) * (table[k + 1][c] - channel)));
  }

  // Return 256 RGBA colours, one for each code of the scalar.
  palette(view) {
    const colors = new Uint8Array(1024).fill(255);
    const scalar = this.scalarOf(view);
    const legend = this.legend();
    for (let code = 0; code < 256; code++) {
      let color = view.color;
      if (scalar >= 0) {
        const level = view.layer.head.scalars[scalar].levels[code];
        color = code === UNKNOWN || level === undefined ? UNKNOWN_COLOR : this.color(level, legend);
      }
      colors.set(color, 4 * code);
    }
    return colors;
  }

  // Call visit(k, x, y, depth) for each `stride`-th point inside the clipping box and the pane, in its pixels.
  eachProjected(layer, camera, { width, height }, stride, visit) {
    const { codes, offset, head } = layer;
    const { x: rx, y: ry, w: rw } = camera.rows(width / height);
    const { low, high } = this.clip;
    const { near } = camera.depths();
    for (let k = 0; k < head.shown; k += stride) {
      const c = 4 * k;
      const x = offset[0] + head.step[0] * codes[c];
      const y = offset[1] + head.step[1] * codes[c + 1];
      const z = offset[2] + head.step[2] * codes[c + 2];
      if (x < low[0] || x > high[0] || y < low[1] || y > high[1] || z < low[2] || z > high[2]) continue;
      const depth = rw[0] * x + rw[1] * y + rw[2] * z + rw[3];
      if (depth < near) continue;
      const across = (0.5 + (0.5 * (rx[0] * x + rx[1] * y + rx[2] * z + rx[3])) / depth) * width;
      const down = (0.5 - (0.5 * (ry[0] * x + ry[1] * y + ry[2] * z + ry[3])) / depth) * height;
      if (across >= 0 && across < width && down >= 0 && down < height) visit(k, across, down, depth);
    }
  }

  // Return the foremost point near a pixel of a pane: {view, at, scalars}, with `at` in real coordinates, or null.
  pick(px, py, camera, pane) {
    let best = null;
    const reach = PICK_PIXELS * this.pixelRatio;
    for (const view of pane.views) {
      this.eachProjected(view.layer, camera, pane, 1, (k, x, y, depth) => {
        const off = Math.hypot(x - px, y - py);
        if (off > reach) return;
        const cost = depth * (1 + (0.02 * off) / reach) + 1e-3 * camera.distance * (off / reach); // near, then central
        if (!best || cost < best.cost) best = { cost, view, k };
      });
    }
    if (!best) return null;
    const { view, k } = best;
    const { head, codes, scalars } = view.layer;
    return {
      view,
      at: head.low.map((low, axis) => low + head.step[axis] * codes[4 * k + axis]),
      scalars: head.scalars
        .map((scalar, s) => ({ key: scalar.key, of: scalar.of, value: scalar.levels[scalars[s][k]] }))
        .filter((scalar) => scalar.of === view.of),
    };
  }

  local(at) {
    return at.map((x, k) => x - this.center[k]);
  }

  // Return an exaggeration at which long arrows span a twentieth of the scene: 1, 2 or 5 times a power of ten.
  usefulExaggeration() {
    const lengths = this.data.arrows.flatMap(({ values }) => {
      const found = [];
      for (let k = 0; k < values.length; k += 6) found.push(Math.hypot(...values.slice(k + 3, k + 6)));
      return found;
    });
    lengths.sort((a, b) => a - b);
    const long = lengths[Math.floor(0.9 * lengths.length)] || 0;
    if (!long) return 1;
    const wanted = (0.1 * this.radius) / long;
    const power = 10 ** Math.floor(Math.log10(wanted));
    return power * [5, 2, 1].find((factor) => factor * power <= wanted);
  }
}

function rgb(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
}

// Return the name of a view in words.
function labelOf({ name, of }, isColored = true) {
  return name || (isColored ? `reference, distance to ${of}` : "reference");
}

// Return the views of a layer: a candidate has one, the reference one for each candidate.
function viewsOf(layer) {
  const { name, scalars } = layer.head;
  if (name) return [{ layer, name, of: "", on: false, color: PLAIN_COLOR }];
  return scalars.map((scalar) => ({ layer, name, of: scalar.of, on: false, color: PLAIN_COLOR }));
}
