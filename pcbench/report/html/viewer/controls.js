// Mouse, touch and keyboard of the view.

const CLICK_PIXELS = 4;
const KEY_STEP = 0.08;

// Connect a canvas with a camera.
//   paneHeight(): height in CSS pixels of what the camera sees
//   onKey(key): act on a key and return whether it has a meaning
//   onChange(): called after the camera moved
//   onPick(x, y): called for a click, in CSS pixels of the canvas
function control(canvas, camera, { paneHeight, onKey, onChange, onPick }) {
  const pointers = new Map();
  let travelled = 0;

  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    if (!pointers.size) travelled = 0;
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });

  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [0, 1].map((k) => (now[k] - before[k]) / paneHeight());
    travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const gap = (at) => Math.max(1, Math.hypot(at[0] - other[0], at[1] - other[1]));
      camera.zoom(gap(before) / gap(now));
      camera.pan(dx / 2, -dy / 2);
    } else if (event.shiftKey || event.buttons & 6) {
      camera.pan(dx, -dy);
    } else {
      camera.orbit(3 * dx, 3 * dy);
    }
    pointers.set(event.pointerId, now);
    onChange();
  });

  const release = (event) => {
    const clicked = pointers.delete(event.pointerId) && !pointers.size && travelled < CLICK_PIXELS;
    if (!clicked || event.type !== "pointerup" || event.button !== 0) return;
    const box = canvas.getBoundingClientRect();
    onPick(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());

  canvas.addEventListener(
    "wheel",
    (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return; // the page scrolls until the view is clicked
      event.preventDefault();
      camera.zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
      onChange();
    },
    { passive: false },
  );

  const moves = {
    ArrowLeft: [-1, 0],
    ArrowRight: [1, 0],
    ArrowUp: [0, 1],
    ArrowDown: [0, -1],
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const move = moves[event.key];
    if (move && event.shiftKey) camera.pan(-KEY_STEP * move[0], -KEY_STEP * move[1]);
    else if (move) camera.orbit(KEY_STEP * move[0], KEY_STEP * move[1]);
    else if (event.key === "+" || event.key === "=") camera.zoom(0.85);
    else if (event.key === "-") camera.zoom(1 / 0.85);
    else if (event.key === "Escape") canvas.blur();
    else if (!onKey(event.key)) return;
    event.preventDefault();
    onChange();
  });
}
