// Draw the scene on a 2D canvas, where WebGL2 is missing: one small square per point, nearest in front.

class Painter {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { willReadFrequently: true });
  }

  draw(scene, camera) {
    const { width, height } = this.canvas;
    const image = this.context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    pixels.fill(packed(...GROUND));
    const depths = new Float32Array(width * height).fill(Infinity);
    for (const view of scene.visible()) {
      const scalar = scene.scalarOf(view);
      const levels = scalar >= 0 ? view.layer.scalars[scalar] : null;
      const palette = scene.palette(view);
      const colors = Uint32Array.from({ length: 256 }, (_, k) => packed(...palette.subarray(4 * k, 4 * k + 3)));
      const { size, smallest, largest } = scene.pointPixels(view.layer, height);
      scene.eachProjected(view.layer, camera, width, height, (k, x, y, depth) => {
        const color = colors[levels ? levels[k] : 0];
        const side = Math.ceil(Math.min(largest, Math.max(smallest, size / depth)));
        const [left, top] = [Math.floor(x - side / 2 + 0.5), Math.floor(y - side / 2 + 0.5)];
        for (let row = Math.max(0, top); row < Math.min(height, top + side); row++) {
          for (let column = Math.max(0, left); column < Math.min(width, left + side); column++) {
            const at = row * width + column;
            if (depth < depths[at]) [depths[at], pixels[at]] = [depth, color];
          }
        }
      });
    }
    this.context.putImageData(image, 0, 0);
    this.drawLines(scene, camera);
  }

  drawLines(scene, camera) {
    const lines = scene.arrowLines();
    const { width, height } = this.canvas;
    this.context.strokeStyle = `rgb(${ARROW_COLOR})`;
    this.context.lineWidth = 2;
    this.context.beginPath();
    for (let k = 0; k < lines.length; k += 6) {
      const from = camera.project(lines.subarray(k, k + 3), width, height);
      const to = camera.project(lines.subarray(k + 3, k + 6), width, height);
      if (!from || !to) continue;
      this.context.moveTo(from[0], from[1]);
      this.context.lineTo(to[0], to[1]);
    }
    this.context.stroke();
  }

  pixel(x, y) {
    return [...this.context.getImageData(x, y, 1, 1).data.slice(0, 3)];
  }
}

function packed(red, green, blue) {
  return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}
