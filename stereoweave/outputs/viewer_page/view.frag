// Finds what a pixel of the view shows. A point of disparity d at s in the left image appears at
// p = s - eye * (d - plane). Going from near to far, the first surface on that line is the visible one.
precision highp float;

const int MOST_STEPS = 256;
const float SAME_SURFACE_PX = 3.0; // largest difference within one surface, as in the renderer
const float NOTHING = -1e6;

varying vec2 place;
uniform sampler2D front, frontDepth, behind, behindDepth, bounds;
uniform vec2 size; // of the front layer, px
uniform vec4 shown; // the rectangle of the left image that the view shows at position 0: left, top, width, height
uniform vec4 behindFrame; // columns and rows added on each side, and size with them
uniform vec2 tiles; // size of the grid of bounds, px
uniform vec2 code; // disparity = code.x + code.y * level
uniform vec2 range; // least and greatest disparity
uniform vec2 eye; // baselines from the left camera: to the right, and down
uniform float plane; // disparity that stays in place

float level(vec4 texel) { return texel.r * 65280.0 + texel.g * 255.0; }

float frontAt(vec2 s) {
  if (s.x < -0.5 || s.y < -0.5 || s.x >= size.x - 0.5 || s.y >= size.y - 0.5) return NOTHING;
  return code.x + code.y * level(texture2D(frontDepth, (s + 0.5) / size));
}

vec2 behindPlace(vec2 s) { return (s + behindFrame.xy + 0.5) / behindFrame.zw; }

float behindAt(vec2 s) { return code.x + code.y * level(texture2D(behindDepth, behindPlace(s))); }

// Part of the pixel that the front surface of disparity d covers at s. As in the renderer, a pixel beside an edge
// counts less the farther the edge has opened, and not at all where it may carry a nearer surface's colour.
float coverage(vec2 s, float d) {
  vec2 first = floor(s), part = s - first;
  float own = 0.0, lost = 0.0, impure = 0.0, stretch = length(eye);
  for (int k = 0; k < 4; k++) {
    vec2 corner = vec2(k == 1 || k == 3 ? 1.0 : 0.0, k > 1 ? 1.0 : 0.0);
    vec2 shares = mix(1.0 - part, part, corner);
    float share = shares.x * shares.y;
    vec4 texel = texture2D(frontDepth, (clamp(first + corner, vec2(0.0), size - 1.0) + 0.5) / size);
    float apart = code.x + code.y * level(texel) - d;
    if (abs(apart) > SAME_SURFACE_PX) lost += share * clamp(stretch * abs(apart), 0.0, 1.0);
    else {
      own += share;
      if (share > 0.001) impure = max(impure, clamp(stretch * texel.b * 255.0 - 1.0, 0.0, 1.0));
    }
  }
  return own < 0.25 ? 0.0 : clamp(1.0 - 2.0 * lost, 0.0, 1.0) * (1.0 - impure);
}

// Disparity of the front layer's visible surface, its coverage, and whether the line passes behind a surface.
vec3 findFront(vec2 p, float low, float high, float steps) {
  float stride = (high - low) / steps;
  float slack = SAME_SURFACE_PX * max(1.0, length(eye) * stride);
  float before = frontAt(p + eye * (high - plane));
  float passed = 0.0;
  for (int i = 1; i <= MOST_STEPS; i++) {
    if (float(i) > steps) break;
    float d = high - stride * float(i);
    float here = frontAt(p + eye * (d - plane));
    float above = before - d - stride, below = here - d;
    float found = NOTHING;
    if (above < 0.0 && below >= 0.0 && abs(here - before) <= slack) found = d + stride * below / (below - above);
    else if (below >= 0.0 && below <= stride) found = here;
    else if (above < 0.0 && before >= d) found = before;
    if (found > NOTHING) {
      float part = coverage(p + eye * (found - plane), found);
      if (part > 0.0) return vec3(found, part, passed);
    }
    if (below >= 0.0) passed = 1.0;
    before = here;
  }
  return vec3(NOTHING, 0.0, 1.0);
}

// Where the line meets the layer behind: its disparity there, and the surface's. A line that passes behind a nearer
// part of the layer goes on; what it would meet there is unknown, so it gets the farther surface beside that part.
vec2 findBehind(vec2 p, float low, float high, float steps) {
  float stride = (high - low) / steps;
  float slack = SAME_SURFACE_PX * max(1.0, length(eye) * stride);
  float before = behindAt(p + eye * (high - plane));
  if (before >= high) return vec2(high);
  vec2 beside = vec2(NOTHING);
  for (int i = 1; i <= MOST_STEPS; i++) {
    if (float(i) > steps) break;
    float d = high - stride * float(i);
    float here = behindAt(p + eye * (d - plane));
    float above = before - d - stride, below = here - d;
    if (above < 0.0 && below >= 0.0 && here - before <= slack) return vec2(d + stride * below / (below - above), here);
    if (above < 0.0 && below >= 0.0 && (beside.y == NOTHING || before < beside.y)) beside = vec2(d + stride, before);
    if (above >= 0.0 && below >= 0.0 && (below <= stride || before - here > slack))
      return beside.y > NOTHING && beside.y < here ? beside : vec2(d, here);
    before = here;
  }
  return beside.y > NOTHING ? beside : vec2(low);
}

void main() {
  vec2 p = shown.xy + place * shown.zw - 0.5;
  vec2 limits = texture2D(bounds, (p + 0.5) / tiles).rg;
  float low = mix(range.x, range.y, limits.r), high = mix(range.x, range.y, limits.g) + code.y;
  float steps = clamp(ceil(length(eye) * (high - low) / 2.0), 1.0, float(MOST_STEPS));
  vec3 found = findFront(p, low, high, steps);
  vec3 colour = texture2D(front, (p + eye * (found.x - plane) + 0.5) / size).rgb;
  if (found.y < 1.0 || found.z > 0.0) {
    vec2 met = findBehind(p, low, high, steps);
    vec3 further = texture2D(behind, behindPlace(p + eye * (met.x - plane))).rgb;
    bool covered = found.z > 0.0 && met.y > found.x + SAME_SURFACE_PX;
    colour = mix(further, colour, covered ? 0.0 : found.y);
  }
  gl_FragColor = vec4(colour, 1.0);
}
