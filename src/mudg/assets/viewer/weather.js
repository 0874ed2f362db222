// A rough preview of the weather and the light that an edit script asks for; `mudg render --edits` draws them, and wet ground.

import { verbOf } from "mudg/edits";
import { rainExtinction, rainSizes, snowExtinction, snowSizes } from "mudg/particles";

/** Visibilities to choose from, metres; 0 = no fog. */
export const VISIBILITIES_M = [0, 1000, 500, 250, 150, 100, 60, 30];
/** Rates to choose from, mm/h of water, and shares of the ground that are white. */
export const RAINS_MM_H = [0, 2, 5, 10, 25, 50], SNOWS_MM_H = [0, 0.5, 1, 2, 4], COVERS = [0, 0.25, 0.5, 0.75, 1];
/** Light by its name in scripts: name for people, factor of red, green and blue, saturation. */
export const LIGHTS = {
  as_recorded: ["As recorded", [1, 1, 1], 1], overcast: ["Overcast", [0.92, 0.95, 1], 0.75], dusk: ["Dusk", [0.62, 0.5, 0.5], 0.85], night: ["Night", [0.24, 0.27, 0.36], 0.6],
};
const EXTINCTION = 3; // Koschmieder: at the distance of the visibility 5 % are left
const MOST_REACH_M = 8; // of drops and flakes that are drawn one by one; the others are a veil
const SNOW = [0.75, 0.22]; // its brightness: a part of its own, and one of the light of the horizon
const DAYLIGHT = [0.76, 0.79, 0.82]; // of fog where a scene has no sky

const last = (edits, verb) => edits.map(verbOf).findLast(([name]) => name === verb)?.[1];

/** What a script asks for; 0 = none. */
export function conditionsOf(edits) {
  const time = last(edits, "light")?.time ?? "as_recorded", { fog, rain, snow } = last(edits, "weather") ?? {};
  return {
    visibility_m: fog ? fog.visibility_m ?? 150 : 0, time: Object.hasOwn(LIGHTS, time) ? time : "as_recorded",
    rain_mm_h: rain ? rain.mm_h ?? 10 : 0, rain_wind: rain?.wind_m_s ?? [0, 0], rain_reach: Math.min(rain?.reach_m ?? 8, MOST_REACH_M),
    snow_mm_h: snow?.mm_h ?? 0, snow_wind: snow?.wind_m_s ?? [0.5, 0], snow_reach: Math.min(snow?.reach_m ?? 8, MOST_REACH_M), cover: snow ? snow.cover ?? 0.6 : 0,
  };
}

/** Numbers for the shaders. @param sky of the scene, or null. */
export function preview(c, sky) {
  const [, factor, saturation] = LIGHTS[c.time], air = horizon(sky);
  return {
    fog: [...air, c.visibility_m ? EXTINCTION / c.visibility_m : 0], light: [...factor, saturation], snow: [...air.map((v) => SNOW[0] + SNOW[1] * v), c.cover],
    veil: [rainExtinction(c.rain_mm_h), c.rain_reach, snowExtinction(c.snow_mm_h), c.snow_reach],
  };
}

/** Kinds of particles in the air, see `streaks`. @param keys of their random numbers. */
export function fallingOf(c, keys) {
  const kinds = [];
  if (c.rain_mm_h) kinds.push({ sizes: rainSizes(c.rain_mm_h), wind: c.rain_wind, reach: c.rain_reach, keys: keys.rain });
  if (c.snow_mm_h) kinds.push({ sizes: snowSizes(c.snow_mm_h), wind: c.snow_wind, reach: c.snow_reach, keys: keys.snow });
  return kinds;
}

/** Mean colour of the sky just above the horizon. */
function horizon(sky) {
  if (!sky) return DAYLIGHT;
  const wide = 2 * sky.rows, first = Math.max(0, Math.floor(sky.rows / 2) - 2), sum = [0, 0, 0], rows = Math.max(1, Math.floor(sky.rows / 2) - first);
  for (let k = 3 * wide * first; k < 3 * wide * (first + rows); k++) sum[k % 3] += sky.values[k];
  return sum.map((value) => value / (255 * wide * rows));
}

/** A script with other conditions; what is as recorded is not in it. */
export function withConditions(edits, wanted) {
  const now = conditionsOf(edits), made = [...edits], differs = (...names) => names.some((name) => wanted[name] !== now[name]);
  const put = (verb, settings) => {
    const at = made.findLastIndex((entry) => verbOf(entry)[0] === verb), kept = Object.keys(settings).length > 0;
    if (at >= 0) made.splice(at, 1, ...(kept ? [{ [verb]: settings }] : []));
    else if (kept) made.push({ [verb]: settings });
  };
  const { fog, rain, snow, ...weather } = last(edits, "weather") ?? {}, { visibility_m, time, rain_mm_h, snow_mm_h, cover } = wanted;
  const part = (name, old, changed, there, values) => { const next = !changed ? old : there ? { ...old, ...values } : undefined; if (next) weather[name] = next; };
  part("fog", fog, differs("visibility_m"), visibility_m, { visibility_m });
  part("rain", rain, differs("rain_mm_h"), rain_mm_h, { mm_h: rain_mm_h });
  part("snow", snow, differs("snow_mm_h", "cover"), snow_mm_h || cover, { mm_h: snow_mm_h, cover });
  if (differs("visibility_m", "rain_mm_h", "snow_mm_h", "cover")) put("weather", weather);
  if (differs("time")) {
    const { time: _, ...rest } = last(edits, "light") ?? {};
    put("light", time === "as_recorded" ? rest : { ...rest, time });
  }
  return made;
}
