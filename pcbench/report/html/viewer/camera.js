// A camera that orbits a target. Coordinates are relative to the centre of the scene.

const FIELD_OF_VIEW = Math.PI / 4;

const HOME = { yaw: -0.6, pitch: 0.75 };
const LEAST_HEADING = 0.2; // horizontal share of a viewing direction that tells from which side it looks

class Camera {
  // `up` is a unit vector; the camera turns about it.
  constructor(up = [0, 0, 1]) {
    this.basis = basisOf(up);
    this.target = [0, 0, 0];
    this.distance = 1;
    this.home = HOME;
    this.front = 0; // the yaw that looks at the front of the scene
    this.yaw = HOME.yaw; // about the up axis; 0 looks along the second axis of the basis: north if z is up
    this.pitch = HOME.pitch; // above the horizon
    this.sceneRadius = 1;
    this.reach = 3; // distance of the farthest thing to draw from the centre
  }

  // Begin on the side from which viewing directions (x, y, z, x, y, z, ...) look; all around tells only above or below.
  startAlong(directions) {
    const mean = [0, 1, 2].map((axis) => average(directions.filter((_, k) => k % 3 === axis)));
    const [east, north, above] = this.basis.map((axis) => dot(axis, mean));
    const level = Math.hypot(east, north);
    const steepest = above > 0 ? -HOME.pitch : HOME.pitch;
    if (level < LEAST_HEADING) this.home = { yaw: HOME.yaw, pitch: steepest };
    else {
      this.front = Math.atan2(east, north);
      this.home = { yaw: this.front, pitch: clamp(Math.atan2(-above, level), -HOME.pitch, HOME.pitch) };
    }
    Object.assign(this, this.home);
  }

  // Begin in front of a wall, whose last axis points towards the viewer.
  startBefore(axes) {
    const [east, north] = this.basis.map((axis) => dot(axis, axes[2]));
    this.home = { yaw: Math.atan2(-east, -north), pitch: 0.05 };
    this.front = this.home.yaw;
    Object.assign(this, this.home);
  }

  // Move so that positions just fill the view.
  fit(points, aspect) {
    const slope = Math.tan(FIELD_OF_VIEW / 2);
    this.target = [0, 1, 2].map((axis) => average(points.map((at) => at[axis])));
    const rounds = 8;
    for (let round = 0; round <= rounds; round++) {
      const { right, up, ahead } = this.axes();
      const along = (axis) => points.map((at) => dot(at, axis) - dot(this.target, axis));
      const [across, above, depth] = [right, up, ahead].map(along);
      const needed = points.map((_, k) => Math.max(Math.abs(across[k]) / aspect, Math.abs(above[k])) / slope - depth[k]);
      this.distance = 1.04 * Math.max(...needed);
      if (round === rounds) return; // with the last distance, all of them are in view
      // Centre the picture: perspective makes the near side larger.
      const seen = (values) => values.map((value, k) => value / (this.distance + depth[k]));
      const middle = (values) => ((Math.min(...values) + Math.max(...values)) / 2) * this.distance;
      const [dx, dy] = [middle(seen(across)), middle(seen(above))];
      this.target = this.target.map((t, k) => t + dx * right[k] + dy * up[k]);
    }
  }

  // Unit vectors to the right, up, and towards the scene.
  axes() {
    const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const world = (at) => [0, 1, 2].map((k) => at.reduce((sum, x, axis) => sum + x * this.basis[axis][k], 0));
    return {
      right: world([cy, -sy, 0]),
      up: world([sp * sy, sp * cy, cp]),
      ahead: world([cp * sy, cp * cy, -sp]),
    };
  }

  position() {
    const { ahead } = this.axes();
    return this.target.map((t, k) => t - ahead[k] * this.distance);
  }

  orbit(dx, dy) {
    this.yaw += dx;
    this.pitch = clamp(this.pitch + dy, -Math.PI / 2, Math.PI / 2);
  }

  // Move the target by a share of the view's height.
  pan(dx, dy) {
    const { right, up } = this.axes();
    const size = 2 * this.distance * Math.tan(FIELD_OF_VIEW / 2);
    this.target = this.target.map((t, k) => t - size * (dx * right[k] + dy * up[k]));
  }

  zoom(factor) {
    const farthest = Math.max(50 * this.sceneRadius, 3 * this.reach); // cameras may be far from the scene
    this.distance = clamp(this.distance * factor, 1e-5 * this.sceneRadius, farthest);
  }

  // Distances of the clipping planes, which enclose the scene.
  depths() {
    const away = Math.hypot(...this.position());
    const far = away + this.reach;
    return { near: Math.max(0.02 * this.distance, far * 1e-4, away - this.reach), far };
  }

  // Rows of the view-projection matrix: 12 numbers for x, y and w of a point in clip coordinates.
  rows(aspect) {
    const { right, up, ahead } = this.axes();
    const eye = this.position();
    const focal = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const row = (axis, scale) => [...axis.map((a) => a * scale), -scale * dot(axis, eye)];
    return { x: row(right, focal / aspect), y: row(up, focal), w: row(ahead, 1) };
  }

  matrix(aspect) {
    const { x, y, w } = this.rows(aspect);
    const { near, far } = this.depths();
    const a = (far + near) / (far - near);
    const z = [a * w[0], a * w[1], a * w[2], a * w[3] - (2 * far * near) / (far - near)];
    const columns = [];
    for (let k = 0; k < 4; k++) columns.push(x[k], y[k], z[k], w[k]);
    return new Float32Array(columns);
  }

  // Return [x, y] in pixels and the depth of a position, or null behind the camera.
  project(at, width, height) {
    const { x, y, w } = this.rows(width / height);
    const along = (row) => dot(row, at) + row[3];
    const depth = along(w);
    if (depth <= 0) return null;
    return [(0.5 + (0.5 * along(x)) / depth) * width, (0.5 - (0.5 * along(y)) / depth) * height, depth];
  }
}

// Return three orthonormal axes of which the last is `up`: the coordinate axes, turned by the least angle.
function basisOf(up) {
  const [a, b, c] = up;
  if (c < -1 + 1e-9) return [[1, 0, 0], [0, -1, 0], up];
  const d = 1 / (1 + c);
  return [[1 - a * a * d, -a * b * d, -a], [-a * b * d, 1 - b * b * d, -b], up];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function normalized(a) {
  const length = Math.hypot(...a);
  return length > 0 ? a.map((x) => x / length) : a;
}

function average(values) {
  return values.reduce((sum, x) => sum + x, 0) / (values.length || 1);
}

function clamp(value, low, high) {
  return Math.min(high, Math.max(low, value));
}
