// Background: the sky's gradient, clouds, and glare around the sun.

uniform mat3 direction_matrix;  // from frame buffer coordinates
uniform sampler2DArray textures;
uniform float cloud_layer;
uniform float clouds;
uniform vec4 fog;  // colour, and density per metre

out vec4 colour;

void main() {
    vec3 direction = normalize(direction_matrix * vec3(gl_FragCoord.xy, 1));
    vec3 seen = sky_radiance(direction);
    float up = max(direction.z, 0);
    // The texture holds the cloud density; the clouds lie on a plane overhead.
    vec2 overhead = direction.xy / (up + 0.15);
    float cloud = texture(textures, vec3(0.2 * overhead, cloud_layer)).r;
    float cover = smoothstep(0.7 - 0.7 * clouds, 1.2 - 0.6 * clouds, cloud) * smoothstep(0.0, 0.15, up);
    vec3 lit = mix(0.6 * horizon, horizon + 0.35 * sun_light, cloud);
    seen = mix(seen, lit, 0.9 * cover);
    float glare = max(dot(direction, sun), 0);
    glare *= glare * glare * glare;
    glare *= glare * glare * glare;
    seen += 0.25 * glare * sun_light;
#ifdef FOG
    seen = mix(seen, fog.rgb, fog.a > 0 ? exp(-10 * up) : 0);
#endif
    colour = tone_mapped(seen);
}
