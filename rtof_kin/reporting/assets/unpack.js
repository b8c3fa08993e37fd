
"use strict";
// Numbers packed by plot_data.py: base64 of little-endian 16-bit integers, -32768 for what is missing.
function unpack(text, scale) {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  const out = new Float32Array(bytes.length / 2);
  for (let i = 0; i < out.length; i++) {
    const whole = view.getInt16(2 * i, true);
    out[i] = whole === -32768 ? NaN : whole / scale;
  }
  return out;
}

// Index of the value nearest to x in an increasing list.
function nearest(list, x) {
  let low = 0, high = list.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (list[middle] > x) high = middle; else low = middle;
  }
  return x - list[low] < list[high] - x ? low : high;
}
