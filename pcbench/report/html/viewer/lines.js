// Lines over the points: displacements, camera positions, and the outline of a tile.

const ARROW_COLOR = [255, 80, 240]; // these colours are in no colour map
const CAMERA_COLOR = [255, 255, 255];
const TILE_COLOR = [255, 160, 20];
const CAMERA_SHARE = 0.05; // length of a drawn camera, as a share of the scene's radius

// Return the lines over some views as {color, width, ends}: width in pixels, and 6 coordinates of two ends per line.
function linesOf(scene, views) {
  const kinds = [
    { color: ARROW_COLOR, width: 2, ends: scene.exaggeration ? arrowLines(scene, views) : [] },
    { color: CAMERA_COLOR, width: 1, ends: scene.showsCameras ? cameraLines(scene) : [] },
    { color: TILE_COLOR, width: 2, ends: scene.tile ? tileLines(scene) : [] },
  ];
  return kinds.filter(({ ends }) => ends.length).map((lines) => ({ ...lines, ends: new Float32Array(lines.ends) }));
}

// Displacements of visible candidates, exaggerated, with small heads.
function arrowLines(scene, views) {
  const lines = [];
  for (const { name, values } of scene.data.arrows) {
    if (!views.some((view) => view.name === name)) continue;
    for (let k = 0; k < values.length; k += 6) {
      const from = scene.local(values.slice(k, k + 3));
      const by = values.slice(k + 3, k + 6).map((d) => d * scene.exaggeration);
      const to = from.map((x, axis) => x + by[axis]);
      const side = Math.hypot(by[0], by[1]) > Math.abs(by[2]) ? [-by[1], by[0], 0] : [by[2], 0, -by[0]];
      lines.push(...from, ...to);
      for (const sign of [-0.12, 0.12]) lines.push(...to, ...to.map((x, a) => x - 0.25 * by[a] + sign * side[a]));
    }
  }
  return lines;
}

// A pyramid per camera, which opens in its viewing direction.
function cameraLines(scene) {
  const { centers, directions } = scene.data.cameras;
  const size = CAMERA_SHARE * scene.radius;
  const lines = [];
  for (let k = 0; k < centers.length; k += 3) {
    const tip = scene.local(centers.slice(k, k + 3));
    const ahead = normalized(directions.slice(k, k + 3));
    const level = cross(ahead, scene.up);
    const right = normalized(Math.hypot(...level) > 1e-6 ? level : cross(ahead, [1, 0.1, 0.2])); // if it looks straight down
    const above = cross(right, ahead);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
      tip.map((t, a) => t + size * (ahead[a] + 0.6 * x * right[a] + 0.4 * y * above[a])),
    );
    corners.forEach((corner, c) => lines.push(...tip, ...corner, ...corner, ...corners[(c + 1) % 4]));
  }
  return lines;
}

// The square of a tile, in the middle of its points.
function tileLines(scene) {
  const { sides, size } = scene.data.tiles;
  const center = scene.local(scene.tile.at);
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map((signs) =>
    center.map((x, axis) => x + ((signs[0] * sides[0][axis] + signs[1] * sides[1][axis]) * size) / 2),
  );
  return corners.flatMap((corner, k) => [...corner, ...corners[(k + 1) % 4]]);
}
