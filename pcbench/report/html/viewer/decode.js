// Decode the points of a layer: the inverse of packing.py.

const UNKNOWN = 255; // code of a scalar that is not known

async function inflate(base64) {
  const binary = atob(base64);
  const bytes = new Uint8Array(binary.length);
  for (let k = 0; k < bytes.length; k++) bytes[k] = binary.charCodeAt(k);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Return {codes, scalars}: four 16-bit numbers per point (x, y, z and padding for the GPU), and a byte per scalar.
async function decode(head, base64) {
  const bytes = await inflate(base64);
  const count = head.shown;
  const codes = new Uint16Array(4 * count);
  for (let axis = 0; axis < 3; axis++) {
    const low = bytes.subarray(2 * axis * count, (2 * axis + 1) * count);
    const high = bytes.subarray((2 * axis + 1) * count, (2 * axis + 2) * count);
    let code = 0;
    for (let k = 0; k < count; k++) {
      const folded = low[k] | (high[k] << 8);
      code = (code + ((folded >>> 1) ^ -(folded & 1))) & 0xffff;
      codes[4 * k + axis] = code;
    }
  }
  const scalars = head.scalars.map((_, s) => bytes.slice((6 + s) * count, (7 + s) * count));
  return { codes, scalars };
}
