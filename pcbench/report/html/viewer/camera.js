// A camera that orbits a target, with z up. Coordinates are relative to the centre of the scene.

const FIELD_OF_VIEW = Math.PI / 4;

class Camera {
  constructor() {
    this.target = [0, 0, 0];
    this.distance = 1;
    this.yaw = -0.6; // about z; 0 looks north
    this.pitch = 0.75; // above the horizon
    this.sceneRadius = 1;
  }

  // Move so that a box just fills the view.
  fit(low, high, aspect) {
    const corners = Array.from({ length: 8 }, (_, k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high : low)[axis]));
    const slope = Math.tan(FIELD_OF_VIEW / 2);
    this.target = low.map((l, k) => (l + high[k]) / 2);
    const rounds = 8;
    for (let round = 0; round <= rounds; round++) {
      const { right, up, ahead } = this.axes();
      const along = (axis) => corners.map((at) => at.reduce((sum, x, k) => sum + (x - this.target[k]) * axis[k], 0));
      const [across, above, depth] = [right, up, ahead].map(along);
      const needed = corners.map((_, k) => Math.max(Math.abs(across[k]) / aspect, Math.abs(above[k])) / slope - depth[k]);
      this.distance = 1.04 * Math.max(...needed);
      if (round === rounds) return; // with the last distance, the whole box is in view
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
    return { right: [cy, -sy, 0], up: [sp * sy, sp * cy, cp], ahead: [cp * sy, cp * cy, -sp] };
  }

  position() {
    const { ahead } = this.axes();
    return this.target.map((t, k) => t - ahead[k] * this.distance);
  }

  orbit(dx, dy) {
    this.yaw += dx;
    this.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, this.pitch + dy));
  }

  // Move the target by a share of the view's height.
  pan(dx, dy) {
    const { right, up } = this.axes();
    const size = 2 * this.distance * Math.tan(FIELD_OF_VIEW / 2);
    this.target = this.target.map((t, k) => t - size * (dx * right[k] + dy * up[k]));
  }

  zoom(factor) {
    this.distance = Math.min(50 * this.sceneRadius, Math.max(1e-5 * this.sceneRadius, this.distance * factor));
  }

  // Distances of the clipping planes, which enclose the scene.
  depths() {
    const away = Math.hypot(...this.position());
    const far = away + 3 * this.sceneRadius;
    return { near: Math.max(0.02 * this.distance, far * 1e-4, away - 3 * this.sceneRadius), far };
  }

  // Rows of the view-projection matrix: 12 numbers for x, y and w of a point in clip coordinates.
  rows(aspect) {
    const { right, up, ahead } = this.axes();
    const eye = this.position();
    const focal = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const row = (axis, scale) => [...axis.map((a) => a * scale), -scale * axis.reduce((s, a, k) => s + a * eye[k], 0)];
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
    const dot = (row) => row[0] * at[0] + row[1] * at[1] + row[2] * at[2] + row[3];
    const depth = dot(w);
    if (depth <= 0) return null;
    return [(0.5 + (0.5 * dot(x)) / depth) * width, (0.5 - (0.5 * dot(y)) / depth) * height, depth];
  }
}
