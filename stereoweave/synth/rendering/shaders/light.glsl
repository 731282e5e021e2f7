// Sky light and tone mapping.

uniform vec3 sun;  // unit vector towards the sun
uniform vec3 sun_light;
uniform vec3 zenith;
uniform vec3 horizon;
uniform vec3 ground;
uniform float exposure;

const float PI = 3.14159265;

// The sky's radiance in a direction.
vec3 sky_radiance(vec3 direction) {
    float up = max(direction.z, 0);
    vec3 above = mix(horizon, zenith, 1.3 * up / (up + 0.3));
    return mix(above, ground, smoothstep(0.0, 0.12, -direction.z));
}

// The sky's irradiance on a surface with this normal.
vec3 sky_irradiance(vec3 direction) {
    float up = 0.5 + 0.5 * direction.z;
    return mix(mix(ground, horizon, up), mix(horizon, mix(horizon, zenith, 0.7), up), up);
}

// Tone curve with soft toe and shoulder: 0.18 becomes 0.23, 1 becomes 0.8. Stored as a square root to avoid
// banding in eight bits.
vec4 tone_mapped(vec3 light) {
    vec3 exposed = exposure * light;
    vec3 dense = exposed * sqrt(exposed);
    return vec4(sqrt(dense / (dense + 0.25)), 1);
}
