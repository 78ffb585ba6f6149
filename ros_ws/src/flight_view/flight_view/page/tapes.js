// The tapes of the instruments: airspeed and altitude over their commands, and the heading.
import {prepared} from "./canvas.js";
import {ticks} from "./charts.js";
import {fixed} from "./units.js";

const BOX = 22; // px, height of the box with the value
const EDGE = 7; // px, within which a label would be cut
const HEADING_SPAN = 90; // deg, that the heading tape shows

function boxed(ctx, text, x, y, width, colour) {
  ctx.fillStyle = colour("--ink");
  ctx.fillRect(x - width / 2, y - BOX / 2, width, BOX);
  ctx.fillStyle = colour("--paper");
  ctx.font = "600 13px system-ui, sans-serif";
  ctx.textAlign = "center";
  ctx.fillText(text, x, y + 1);
}

// A vertical tape. `span`: what the tape shows of the values, in their unit; `right`: whether its marks are at the right edge.
export function drawTape(canvas, {name, unit, value, command, span, right}, colour) {
  const {ctx, width, height} = prepared(canvas), top = 16, middle = top + (height - top) / 2, scale = (height - top) / span;
  const y = shown => middle - (shown - value) * scale;
  ctx.fillStyle = colour("--panel");
  ctx.fillRect(0, top, width, height - top);
  ctx.font = "11px system-ui, sans-serif";
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  ctx.fillStyle = colour("--quiet");
  ctx.fillText(`${name} (${unit})`, width / 2, 8, width);
  if (!Number.isFinite(value)) {
    ctx.fillText("-", width / 2, middle);
    return;
  }
  ctx.save();
  ctx.beginPath();
  ctx.rect(0, top, width, height - top);
  ctx.clip();
  ctx.strokeStyle = colour("--quiet");
  ctx.lineWidth = 1;
  ctx.textAlign = right ? "right" : "left";
  for (const {value: mark, text} of ticks(value - span / 2, value + span / 2, 6)) {
    ctx.beginPath();
    ctx.moveTo(right ? width : 0, y(mark));
    ctx.lineTo(right ? width - 6 : 6, y(mark));
    ctx.stroke();
    if (Math.abs(y(mark) - middle) < (height - top) / 2 - EDGE) ctx.fillText(text, right ? width - 9 : 9, y(mark));
  }
  ctx.restore();
  boxed(ctx, fixed(value, span < 50 ? 1 : 0), width / 2, middle, width - 14, colour);
  if (!Number.isFinite(command)) return;
  const at = Math.min(Math.max(y(command), top + 5), height - 5), edge = right ? width : 0, inwards = right ? -1 : 1;
  ctx.fillStyle = colour("--reference"); // the command: a notch at the edge, at the end of the tape where it is beyond
  ctx.fillRect(right ? width - 4 : 0, at - 5, 4, 10);
  ctx.beginPath();
  ctx.moveTo(edge + 4 * inwards, at - 5);
  ctx.lineTo(edge + 10 * inwards, at);
  ctx.lineTo(edge + 4 * inwards, at + 5);
  ctx.fill();
}

// The heading tape, deg; `command` is NaN without one.
export function drawHeading(canvas, value, command, colour) {
  const {ctx, width, height} = prepared(canvas), scale = width / HEADING_SPAN;
  ctx.fillStyle = colour("--panel");
  ctx.fillRect(0, 0, width, height);
  ctx.textBaseline = "middle";
  ctx.font = "11px system-ui, sans-serif";
  ctx.textAlign = "center";
  ctx.fillStyle = ctx.strokeStyle = colour("--quiet");
  if (!Number.isFinite(value)) {
    ctx.fillText("-", width / 2, height / 2);
    return;
  }
  const x = degrees => width / 2 + (((degrees - value + 540) % 360) - 180) * scale;
  const names = {0: "N", 90: "E", 180: "S", 270: "W"};
  for (let degrees = 0; degrees < 360; degrees += 10) {
    if (Math.abs(x(degrees) - width / 2) > width / 2) continue;
    ctx.beginPath();
    ctx.moveTo(x(degrees), height);
    ctx.lineTo(x(degrees), height - (degrees % 30 ? 4 : 8));
    ctx.stroke();
    if (degrees % 30 === 0) ctx.fillText(names[degrees] ?? `${degrees}`, x(degrees), height - 16);
  }
  boxed(ctx, String(Math.round(value + 360) % 360).padStart(3, "0"), width / 2, BOX / 2, 40, colour);
  if (!Number.isFinite(command)) return;
  const at = Math.min(Math.max(x(command), 6), width - 6);
  ctx.fillStyle = colour("--reference");
  ctx.beginPath();
  ctx.moveTo(at - 6, 0);
  ctx.lineTo(at + 6, 0);
  ctx.lineTo(at, 9);
  ctx.fill();
}
