// Draw the scene on a 2D canvas, where WebGL2 is missing: one small square per point, nearest in front.

class Painter {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { willReadFrequently: true });
  }

  // Draw panes as `WebglRenderer.draw` does; `stride` skips points.
  draw(scene, camera, panes, stride = 1) {
    const { width, height } = this.canvas;
    const image = this.context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    pixels.fill(packed(...GROUND));
    const depths = new Float32Array(width * height).fill(Infinity);
    for (const pane of panes) {
      for (const view of pane.views) this.drawPoints(scene, view, camera, pane, stride, { pixels, depths });
    }
    this.context.putImageData(image, 0, 0);
    for (const pane of panes) {
      for (const lines of linesOf(scene, pane.views)) this.drawLines(lines, camera, pane);
    }
  }

  drawPoints(scene, view, camera, pane, stride, { pixels, depths }) {
    const scalar = scene.scalarOf(view);
    const levels = scalar >= 0 ? view.layer.scalars[scalar] : null;
    const palette = scene.palette(view);
    const colors = Uint32Array.from({ length: 256 }, (_, k) => packed(...palette.subarray(4 * k, 4 * k + 3)));
    const { size, smallest, largest } = scene.pointPixels(view.layer, pane.height);
    const across = this.canvas.width;
    scene.eachProjected(view.layer, camera, pane, stride, (k, x, y, depth) => {
      const color = colors[levels ? levels[k] : 0];
      const side = Math.ceil(clamp((Math.sqrt(stride) * size) / depth, smallest, largest));
      const [left, top] = [Math.floor(x - side / 2 + 0.5), Math.floor(y - side / 2 + 0.5)];
      for (let row = Math.max(0, top); row < Math.min(pane.height, top + side); row++) {
        for (let column = Math.max(0, left); column < Math.min(pane.width, left + side); column++) {
          const at = (pane.y + row) * across + pane.x + column;
          if (depth >= depths[at]) continue;
          depths[at] = depth;
          pixels[at] = color;
        }
      }
    });
  }

  drawLines({ color, width, ends }, camera, pane) {
    const { context } = this;
    context.save();
    context.beginPath();
    context.rect(pane.x, pane.y, pane.width, pane.height);
    context.clip();
    context.translate(pane.x, pane.y);
    context.strokeStyle = `rgb(${color})`;
    context.lineWidth = width;
    context.beginPath();
    for (let k = 0; k < ends.length; k += 6) {
      const from = camera.project(ends.subarray(k, k + 3), pane.width, pane.height);
      const to = camera.project(ends.subarray(k + 3, k + 6), pane.width, pane.height);
      if (!from || !to) continue;
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
    }
    context.stroke();
    context.restore();
  }

  async finished() {} // as soon as it is drawn

  pixel(x, y) {
    return [...this.context.getImageData(x, y, 1, 1).data.slice(0, 3)];
  }
}

function packed(red, green, blue) {
  return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}
