// Panes of the canvas: one for all clouds, or one for each cloud side by side, with the same camera.

const MAX_PANES = 4;
const PANE_GAP = 2; // in CSS pixels

// Return the visible views that are drawn: side by side the first ones, references first.
function drawnViews(scene) {
  const shown = scene.visible();
  if (!scene.sideBySide) return shown;
  return [...shown.filter((view) => !view.name), ...shown.filter((view) => view.name)].slice(0, MAX_PANES);
}

// Divide a canvas of a size in pixels; return panes {views, x, y, width, height}, counted from the upper left corner.
function panesOf(scene, width, height) {
  const shown = drawnViews(scene);
  const groups = scene.sideBySide && shown.length > 1 ? shown.map((view) => [view]) : [shown];
  const { columns, rows } = gridOf(groups.length, width, height);
  const gap = Math.round(PANE_GAP * scene.pixelRatio);
  const edges = (count, length) => Array.from({ length: count + 1 }, (_, k) => Math.round((k / count) * (length + gap)));
  const [across, down] = [edges(columns, width), edges(rows, height)];
  return groups.map((views, k) => {
    const [column, row] = [k % columns, Math.floor(k / columns)];
    const [x, y] = [across[column], down[row]];
    return { views, x, y, width: Math.max(1, across[column + 1] - gap - x), height: Math.max(1, down[row + 1] - gap - y) };
  });
}

// Return the number of columns and rows at which the shorter sides of `count` panes are longest.
function gridOf(count, width, height) {
  const grids = Array.from({ length: count }, (_, k) => ({ columns: k + 1, rows: Math.ceil(count / (k + 1)) }));
  const shorter = ({ columns, rows }) => Math.min(width / columns, height / rows);
  return grids.reduce((best, grid) => (shorter(grid) > shorter(best) ? grid : best));
}

// The elements over the canvas: each pane has its name, if there are several, and a ring around the marked place.
// Their places are shares of the canvas, which may have another size on paper.
class Overlay {
  constructor(element) {
    this.element = element;
  }

  // Bring the overlay up to date with a canvas; `marked` is a position relative to the scene's centre, or null.
  show(scene, camera, panes, marked, canvas) {
    while (this.element.children.length > panes.length) this.element.lastChild.remove();
    while (this.element.children.length < panes.length) this.element.append(paneElement());
    panes.forEach((pane, k) => {
      const { x, y, width, height } = pane;
      const box = this.element.children[k];
      const [label, marker] = box.children;
      setShares(box, { left: x / canvas.width, top: y / canvas.height, width: width / canvas.width, height: height / canvas.height });
      label.textContent = labelOfPane(scene, pane, panes.length);
      const spot = marked && camera.project(marked, width, height);
      marker.hidden = !spot;
      if (spot) setShares(marker, { left: spot[0] / width, top: spot[1] / height });
    });
  }
}

function labelOfPane(scene, pane, count) {
  if (!pane.views.length) return "No cloud is selected.";
  return count > 1 ? labelOf(pane.views[0], scene.scalarOf(pane.views[0]) >= 0) : "";
}

function paneElement() {
  const [pane, label, marker] = ["pane", "pane-name", "marker"].map((name) => {
    const made = document.createElement("div");
    made.className = name;
    return made;
  });
  pane.append(label, marker);
  return pane;
}

function setShares(element, shares) {
  for (const [side, share] of Object.entries(shares)) element.style[side] = `${100 * share}%`;
}
