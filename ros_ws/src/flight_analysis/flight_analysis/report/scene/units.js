// Units of the instruments and of the map, by choice. The samples are in SI: shown value = sample * factor.

const KNOT = 1852 / 3600, FOOT = 0.3048, MILE = 1852; // m/s, m and m, exact
const METRES = {height: {unit: "m", factor: 1}, climb: {unit: "m/s", factor: 1}, near: {unit: "m", factor: 1}, far: {unit: "km", factor: 1e-3}};
const FEET = {height: {unit: "ft", factor: 1 / FOOT}, climb: {unit: "ft/min", factor: 60 / FOOT}, near: {unit: "ft", factor: 1 / FOOT}, far: {unit: "NM", factor: 1 / MILE}};
const KNOTS = {unit: "kt", factor: 1 / KNOT};

export const UNITS = {
  "m, m/s": {speed: {unit: "m/s", factor: 1}, ...METRES},
  "m, kt": {speed: KNOTS, ...METRES},
  "ft, kt": {speed: KNOTS, ...FEET},
};

// A number with so many digits; 0 has no sign.
export const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]+$)/, "");

// A value with its unit; "-" without a value.
export function shownAs({unit, factor}, value, digits) {
  return Number.isFinite(value) ? `${fixed(value * factor, digits)} ${unit}` : "-";
}

// A distance in the near unit, or from 1000 m on in the far one.
export function distanceText(units, metres) {
  return Math.abs(metres) < 1000 ? shownAs(units.near, metres, 0) : shownAs(units.far, metres, 1);
}

// A wind as a pilot reads it: the speed, and where the air comes from, by where the air moves to, m/s.
export function windText(units, north, east) {
  const from = (Math.round(Math.atan2(-east, -north) * 180 / Math.PI) + 360) % 360;
  return `${shownAs(units.speed, Math.hypot(north, east), 1)} from ${String(from).padStart(3, "0")} deg`;
}
