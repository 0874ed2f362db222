// The programs of the graphics card. They follow core/raster/torch_twin.py: elliptical weighted averaging, 0.3 square pixels of blur,
// alpha at most 0.99 and at least 1/255, pixel centres at one half.

/** Kinds of pictures, in the order in which the programs number them. */
export const LAYERS = ["color", "depth", "class", "instance", "normal", "confidence", "recorded"];
/** Classes counted in one pass: four targets with three classes each; every target needs its alpha for blending. */
export const CLASSES_PER_PASS = 12;

const HEAD = `#version 300 es
precision highp float; precision highp int; precision highp usampler2DArray; precision highp sampler2D;
`;

/** Four corners per Gaussian. 'degree': of the spherical harmonics; 'texels': of the data texture per Gaussian; 'rows': per layer of it. */
export const splatVertex = (degree, texels, width, rows) => HEAD + `
uniform usampler2DArray data; uniform sampler2D nodes, grids;
uniform mat3 cameraFromWorld; uniform vec3 eye; uniform vec4 intrinsics; uniform vec2 size;
uniform vec2 colorRange; uniform vec4 fog, veil, snow; uniform uint ground; uniform float harmonicStep, nearest; uniform int layer; uniform bool antialias;
uniform sampler2D balls; uniform vec4 boxPlace; uniform vec3 boxHalf; uniform vec2 boxHeading; uniform int ballCount; // what is erased of the street
in uint row;
out vec2 place; flat out vec4 payload; flat out uvec2 vote;

uvec4 word(int k) { int at = int(row) % ${rows} * ${texels} + k; return texelFetch(data, ivec3(at % ${width}, at / ${width}, int(row) / ${rows}), 0); }

mat3 turned(uint code) { // smallest three, w x y z
  vec3 small = (vec3(code & 1023u, (code >> 10) & 1023u, (code >> 20) & 1023u) - 512.0) / (511.0 * 1.41421356);
  float left = sqrt(max(0.0, 1.0 - dot(small, small)));
  uint absent = code >> 30;
  vec4 q = absent == 0u ? vec4(left, small) : absent == 1u ? vec4(small.x, left, small.yz)
         : absent == 2u ? vec4(small.xy, left, small.z) : vec4(small, left);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 displaced(vec3 mean, int node, float base) { // three-linear in a grid of control points over the box, held at its border
  vec3 box = texelFetch(nodes, ivec2(4, node), 0).xyz, cells = texelFetch(nodes, ivec2(5, node), 0).xyz;
  vec3 at = clamp((mean / box + 0.5) * (cells - 1.0), vec3(0.0), cells - 1.0);
  vec3 low = min(floor(at), cells - 2.0), part = at - low, sum = vec3(0.0);
  for (int k = 0; k < 8; k++) {
    vec3 corner = vec3(k & 1, (k >> 1) & 1, k >> 2), weights = mix(1.0 - part, part, corner), c = low + corner;
    int cell = int(base + (c.z * cells.y + c.y) * cells.x + c.x);
    sum += weights.x * weights.y * weights.z * texelFetch(grids, ivec2(cell % ${width}, cell / ${width}), 0).xyz;
  }
  return mean + sum;
}
${degree ? `
float level(int k) { uint four = word(2 + k / 16)[(k / 4) % 4]; return float((four >> uint(8 * (k % 4))) & 255u) - 128.0; }
vec3 band(int k) { return harmonicStep * vec3(level(3 * k), level(3 * k + 1), level(3 * k + 2)); }
vec3 harmonics(vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  vec3 sum = -0.48860251190292 * y * band(0) + 0.48860251190292 * z * band(1) - 0.48860251190292 * x * band(2);
  ${degree > 1 ? `
  float c2 = x * x - y * y, s2 = 2.0 * x * y;
  sum += 0.5462742152960395 * s2 * band(3) - 1.092548430592079 * y * z * band(4) + (0.9461746957575601 * z * z - 0.3153915652525201) * band(5)
       - 1.092548430592079 * x * z * band(6) + 0.5462742152960395 * c2 * band(7);` : ""}
  ${degree > 2 ? `
  float c3 = x * c2 - y * s2, s3 = x * s2 + y * c2, z2 = z * z;
  sum += -0.5900435899266435 * s3 * band(8) + 1.445305721320277 * z * s2 * band(9) - 0.4570457994644658 * y * (5.0 * z2 - 1.0) * band(10)
       + 0.3731763325901154 * z * (5.0 * z2 - 3.0) * band(11) - 0.4570457994644658 * x * (5.0 * z2 - 1.0) * band(12)
       + 1.445305721320277 * z * c2 * band(13) - 0.5900435899266435 * c3 * band(14);` : ""}
  return sum;
}` : ""}

vec3 tint(int node) { return node == 0 ? vec3(0.42) : 0.55 + 0.45 * cos(6.2831853 * (fract(float(node) * 0.61803399) + vec3(0.0, 0.33, 0.67))); }

bool erased(vec3 at) { // as in editing/apply.py
  for (int k = 0; k < ballCount; k++) {
    vec4 ball = texelFetch(balls, ivec2(k % ${width}, k / ${width}), 0);
    if (distance(at, ball.xyz) <= ball.w) return true;
  }
  if (boxPlace.w < 0.5) return false;
  vec3 way = at - boxPlace.xyz;
  vec2 own = vec2(dot(way.xy, boxHeading), dot(way.xy, vec2(-boxHeading.y, boxHeading.x)));
  return any(greaterThan(abs(vec3(own, way.z)), boxHalf));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: nothing is drawn
  place = vec2(0.0); payload = vec4(0.0); vote = uvec2(255u, 0u);
  uvec4 first = word(0), second = word(1);
  int node = int(first.w & 65535u);
  vec4 state = texelFetch(nodes, ivec2(3, node), 0);
  float opacity = float((second.z >> 16) & 255u) / 255.0;
  if (state.x < 0.5 || opacity * 255.0 < 1.0) return;
  vec4 r0 = texelFetch(nodes, ivec2(0, node), 0), r1 = texelFetch(nodes, ivec2(1, node), 0), r2 = texelFetch(nodes, ivec2(2, node), 0);
  vec3 mean = uintBitsToFloat(first.xyz);
  if (state.y >= 0.0) mean = displaced(mean, node, state.y);
  vec3 fromEye = vec3(dot(r0.xyz, mean) + r0.w, dot(r1.xyz, mean) + r1.w, dot(r2.xyz, mean) + r2.w) - eye;
  vec3 c = cameraFromWorld * fromEye;
  if (c.z <= nearest || (node == 0 && erased(fromEye + eye))) return;

  mat3 worldFromNode = transpose(mat3(r0.xyz, r1.xyz, r2.xyz)), axes = worldFromNode * turned(second.x);
  vec2 xy = unpackHalf2x16(second.y);
  vec3 scale = vec3(xy, unpackHalf2x16(second.z & 65535u).x);
  mat3 shape = cameraFromWorld * axes; // columns: the axes of the Gaussian as the camera sees them
  vec2 focal = intrinsics.xy, center = intrinsics.zw, slack = 0.15 * size / focal, slope = c.xy / c.z;
  vec2 held = clamp(slope, -center / focal - slack, (size - center) / focal + slack);
  vec3 jx = vec3(1.0, 0.0, -held.x) * focal.x / c.z, jy = vec3(0.0, 1.0, -held.y) * focal.y / c.z;
  vec3 hx = (jx * shape) * scale, hy = (jy * shape) * scale; // unit sphere to ellipse: two rows
  float xx = dot(hx, hx) + 0.3, xy2 = dot(hx, hy), yy = dot(hy, hy) + 0.3;
  vec3 area = cross(hx, hy);
  float det = dot(area, area) + 0.3 * (xx + yy - 0.3);
  if (antialias) opacity *= sqrt(max(dot(area, area) / det, 1e-6)); // blurring adds no light
  if (opacity * 255.0 < 1.0) return;
  float middle = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy2)), l1 = middle + spread, l2 = det / l1;
  vec2 along = abs(xy2) < 1e-6 * l1 ? (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0)) : normalize(vec2(xy2, l1 - xx));
  float reach = sqrt(2.0 * log(opacity * 255.0)) + 0.02;
  vec2 mid = focal * slope + center, extent = reach * sqrt(vec2(xx, yy));
  if (any(lessThan(mid + extent, vec2(0.0))) || any(greaterThan(mid - extent, size))) return;

  place = reach * vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID & 2) - 1);
  vec2 pixel = mid + place.x * sqrt(l1) * along + place.y * sqrt(l2) * vec2(-along.y, along.x);
  gl_Position = vec4(pixel / size * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);

  vote = uvec2((first.w >> 16) & 255u, first.w >> 24);
  payload.a = opacity;
  if (layer == 0) {
    uvec3 levels = uvec3(second.w, second.w >> 8, second.w >> 16) & 255u;
    payload.rgb = mix(vec3(colorRange.x), vec3(colorRange.y), vec3(levels) / 255.0);
    ${degree ? "payload.rgb += harmonics(normalize(fromEye * worldFromNode));" : ""}
    payload.rgb = max(payload.rgb, 0.0); // what follows is a preview
    if (vote.x < 32u && ((ground >> vote.x) & 1u) == 1u) payload.rgb = mix(payload.rgb, snow.rgb, snow.a);
    float way = length(fromEye), thin = fog.a * way + veil.x * max(way - veil.y, 0.0) + veil.z * max(way - veil.w, 0.0);
    payload.rgb = mix(fog.rgb, payload.rgb, exp(-thin));
  } else if (layer == 1) payload.rgb = vec3(c.z);
  else if (layer == 3) payload.rgb = tint(node);
  else if (layer == 4) { // the shortest axis, towards the camera
    vec3 normal = scale.x <= scale.y && scale.x <= scale.z ? axes[0] : scale.y <= scale.z ? axes[1] : axes[2];
    payload.rgb = 0.5 + 0.5 * (dot(normal, fromEye) > 0.0 ? -normal : normal);
  } else if (layer == 5) payload.rgb = vec3(float(second.w >> 24) / 255.0);
}`;

const ALPHA = `float alpha = min(0.99, payload.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;`;

/** One target: what a Gaussian shows, times alpha. */
export const splatFragment = HEAD + `
in vec2 place; flat in vec4 payload; flat in uvec2 vote; out vec4 color;
void main() { ${ALPHA}
  color = vec4(payload.rgb * alpha, alpha); }`;

/** Four targets: votes for the classes from 'firstClass' on, three per target. */
export const voteFragment = HEAD + `
in vec2 place; flat in vec4 payload; flat in uvec2 vote; uniform int firstClass;
layout(location = 0) out vec4 a; layout(location = 1) out vec4 b; layout(location = 2) out vec4 c; layout(location = 3) out vec4 d;
vec4 votes(int k, float alpha) { int own = int(vote.x) - firstClass - k; float lead = alpha * float(vote.y);
  return vec4(own == 0 ? lead : 0.0, own == 1 ? lead : 0.0, own == 2 ? lead : 0.0, alpha); }
void main() { ${ALPHA}
  a = votes(0, alpha); b = votes(3, alpha); c = votes(6, alpha); d = votes(9, alpha); }`;

/** A triangle that covers everything. */
export const screenVertex = HEAD + `
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;

/** Sums of one layer to a picture: sky behind colours, depth and confidence through their colour scales. */
const GROUND = "0.43, 0.43, 0.42"; // as `view.GROUND`

export const resolveFragment = HEAD + `
uniform sampler2D sums, sky, scales; uniform int layer; uniform bool hasSky;
uniform mat3 worldFromCamera; uniform vec4 intrinsics; uniform vec2 size, depthRange; uniform bool ground; uniform vec3 gain, offset; uniform vec4 fog, light, veil;
out vec4 color;
void main() {
  vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
  vec3 rgb = sum.rgb;
  if (layer == 0) {
    if (hasSky) {
      vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
      vec3 ray = worldFromCamera * vec3((pixel - intrinsics.zw) / intrinsics.xy, 1.0);
      vec2 at = vec2(atan(ray.y, ray.x) / 6.2831853 + 0.5, 0.5 - atan(ray.z, length(ray.xy)) / 3.14159265);
      vec3 behind = ground && ray.z < 0.0 ? vec3(${GROUND}) : texture(sky, at).rgb;
      float thin = 300.0 * fog.a + 1000.0 * (veil.x + veil.z); // fog is 300 m high, clouds are 1000 m up
      behind = mix(fog.rgb, behind, exp(-thin / max(ray.z / length(ray), 0.01)));
      rgb += (1.0 - sum.a) * behind;
    }
    rgb = gain * rgb + offset;
    rgb = light.rgb * mix(vec3(dot(rgb, vec3(0.2126, 0.7152, 0.0722))), rgb, light.a);
  } else if (layer == 1) {
    float t = clamp(log(sum.r / max(sum.a, 1e-6) / depthRange.x) / log(depthRange.y / depthRange.x), 0.0, 1.0);
    rgb = sum.a < 0.5 ? vec3(0.0) : texture(scales, vec2((t * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  } else if (layer == 3) rgb += (1.0 - sum.a) * vec3(0.06, 0.07, 0.09);
  else if (layer == 4) rgb += (1.0 - sum.a) * vec3(0.5);
  else if (layer == 5) { // below 0.1 depth is mostly wrong, above 0.4 hardly ever
    float c = clamp(sum.r, 0.0, 1.0);
    vec3 sure = mix(vec3(0.93, 0.75, 0.25), vec3(0.16, 0.60, 0.42), smoothstep(0.15, 0.4, c));
    rgb = mix(vec3(0.55, 0.12, 0.10), sure, smoothstep(0.02, 0.18, c)) * (0.35 + 0.65 * sum.a);
  }
  color = vec4(clamp(rgb, 0.0, 1.0), 1.0);
}`;

/** Streaks of drops and flakes: rectangles between two ends, as wide as they are and at least a pixel. */
export const dropVertex = HEAD + `
uniform vec2 size; in vec4 ends; in vec3 about; // width in pixels, camera z, how much of a pixel is covered in all
flat out float z, thin;
void main() {
  vec2 way = ends.zw - ends.xy; float far = length(way), half_ = 0.5 * max(about.x, 1.0);
  vec2 along = far > 1e-4 ? way / far : vec2(1.0, 0.0);
  vec2 at = mix(ends.xy - half_ * along, ends.zw + half_ * along, float(gl_VertexID >> 1)) + half_ * float((gl_VertexID & 1) * 2 - 1) * vec2(-along.y, along.x);
  z = about.y; thin = about.z / (2.0 * half_ * (far + 2.0 * half_));
  gl_Position = vec4(at / size * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);
}`;

export const dropFragment = HEAD + `
uniform sampler2D depths; uniform vec3 color; flat in float z, thin; out vec4 drawn;
void main() {
  vec4 sum = texelFetch(depths, ivec2(gl_FragCoord.xy), 0);
  if (sum.a >= 0.5 && z > sum.r / sum.a) discard;
  drawn = vec4(color, 1.0 - exp(-thin));
}`;

/** Votes to the class with most of them; 'colors' false: its number / 255 instead of its colour. */
export const classFragment = (classes) => HEAD + `
uniform sampler2D ${Array.from({ length: Math.ceil(classes / 3) }, (_, k) => `votes${k}`).join(", ")};
uniform vec3 palette[${classes}]; uniform float ids[${classes}]; uniform int skyChannel; uniform float skyVotes; uniform bool colors, hasSky;
out vec4 color;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float counts[${Math.ceil(classes / 3) * 3}]; float alpha = 0.0; vec4 v;
  ${Array.from({ length: Math.ceil(classes / 3) }, (_, k) => `v = texelFetch(votes${k}, at, 0); alpha = v.a; counts[${3 * k}] = v.r; counts[${3 * k + 1}] = v.g; counts[${3 * k + 2}] = v.b;`).join("\n  ")}
  int best = 0; float most = -1.0;
  for (int k = 0; k < ${classes}; k++) {
    float here = counts[k] + (k == skyChannel ? skyVotes * (1.0 - alpha) : 0.0);
    if (here > most) { most = here; best = k; }
  }
  if (hasSky && skyChannel >= 0 && alpha < 0.5) best = skyChannel;
  color = colors ? vec4(palette[best], 1.0) : vec4(ids[best] / 255.0);
}`;

/** The two pictures of a comparison on the page: side by side at a divider, or how they differ. */
export const showFragment = HEAD + `
uniform sampler2D left, right; uniform int mode; uniform float divider; uniform vec4 area; uniform bvec2 upright; out vec4 color;
vec3 of(sampler2D picture, vec2 at, bool flip) { return texture(picture, flip ? vec2(at.x, 1.0 - at.y) : at).rgb; }
void main() {
  vec2 at = (gl_FragCoord.xy - area.xy) / area.zw;
  vec3 a = of(left, at, upright.x), b = mode == 0 ? a : of(right, at, upright.y);
  vec3 rgb = mode == 0 ? a : mode == 1 ? (at.x < divider ? a : b) : min(vec3(1.0), 3.0 * abs(a - b));
  if (mode == 1 && abs(at.x - divider) * area.z < 1.0) rgb = vec3(1.0);
  color = vec4(rgb, 1.0);
}`;
