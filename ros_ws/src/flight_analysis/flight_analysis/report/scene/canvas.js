// What all canvases share: their resolution, and the colours of the modes of the controller.

export const MODE_COLOURS = {0: "#b0b0b0", 1: "#2f9e6e", 2: "#f2c230", 3: "#ef7d17", 4: "#8a63b8", 5: "#5f6b73"};

// A canvas at the resolution of the screen: its context, and its width and height in CSS pixels.
export function prepared(canvas) {
  const scale = devicePixelRatio || 1, {clientWidth: width, clientHeight: height} = canvas;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(scale, 0, 0, scale, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return {ctx, width, height};
}
