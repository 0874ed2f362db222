// A rough preview of the fog and the light that an edit script asks for; `mudg render --edits` draws them, and rain, snow and wet ground.

import { verbOf } from "mudg/edits";

/** Visibilities to choose from, metres; 0 = no fog. */
export const VISIBILITIES_M = [0, 1000, 500, 250, 150, 100, 60, 30];
/** Light by its name in scripts: name for people, factor of red, green and blue, saturation. */
export const LIGHTS = {
  as_recorded: ["As recorded", [1, 1, 1], 1], overcast: ["Overcast", [0.92, 0.95, 1], 0.75], dusk: ["Dusk", [0.62, 0.5, 0.5], 0.85], night: ["Night", [0.24, 0.27, 0.36], 0.6],
};
const EXTINCTION = 3; // Koschmieder: at the distance of the visibility 5 % are left
const DAYLIGHT = [0.76, 0.79, 0.82]; // of fog where a scene has no sky

const last = (edits, verb) => edits.map(verbOf).findLast(([name]) => name === verb)?.[1];

/** What a script asks for: {visibility_m, time}. */
export function conditionsOf(edits) {
  const time = last(edits, "light")?.time ?? "as_recorded", fog = last(edits, "weather")?.fog;
  return { visibility_m: fog ? fog.visibility_m ?? 150 : 0, time: Object.hasOwn(LIGHTS, time) ? time : "as_recorded" };
}

/** Whether the page shows something else than the fit. */
export const changes = ({ visibility_m: visibility, time }) => visibility > 0 || time !== "as_recorded";

/** Numbers for the shaders. @param sky of the scene, or null. */
export function preview({ visibility_m: visibility, time }, sky) {
  const [, factor, saturation] = LIGHTS[time];
  return { fog: [...horizon(sky), visibility ? EXTINCTION / visibility : 0], light: [...factor, saturation] };
}

/** Mean colour of the sky just above the horizon. */
function horizon(sky) {
  if (!sky) return DAYLIGHT;
  const wide = 2 * sky.rows, first = Math.max(0, Math.floor(sky.rows / 2) - 2), sum = [0, 0, 0], rows = Math.max(1, Math.floor(sky.rows / 2) - first);
  for (let k = 3 * wide * first; k < 3 * wide * (first + rows); k++) sum[k % 3] += sky.values[k];
  return sum.map((value) => value / (255 * wide * rows));
}

/** A script with another visibility or light; what is as recorded is not in it. */
export function withConditions(edits, { visibility_m: visibility, time }) {
  const now = conditionsOf(edits), made = [...edits];
  const put = (verb, settings) => {
    const at = made.findLastIndex((entry) => verbOf(entry)[0] === verb);
    if (at >= 0) made.splice(at, 1, ...(settings ? [{ [verb]: settings }] : []));
    else if (settings) made.push({ [verb]: settings });
  };
  if (visibility !== now.visibility_m) {
    const { fog, ...rest } = last(edits, "weather") ?? {}, more = visibility ? { ...rest, fog: { ...fog, visibility_m: visibility } } : rest;
    put("weather", Object.keys(more).length ? more : null);
  }
  if (time !== now.time) {
    const { time: _, ...rest } = last(edits, "light") ?? {}, more = time === "as_recorded" ? rest : { ...rest, time };
    put("light", Object.keys(more).length ? more : null);
  }
  return made;
}
