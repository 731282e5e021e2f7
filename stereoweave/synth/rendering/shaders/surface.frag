// Surface lit by sun, sky and lamps.

struct Material {
    vec3 tint;
    float roughness;
    float layer;
    float repeats_per_m;
    float metal;
    float relief_m;
    float glow;
};

layout(std140) uniform Materials {
    Material materials[MATERIALS];
};

uniform vec3 eye_m;
uniform sampler2DArray textures;
#if LAMPS > 0
uniform vec3 lamp_m[LAMPS];
uniform vec3 lamp_light[LAMPS];
#endif
uniform vec4 fog;  // colour, and density per metre

in vec3 place_m;
in vec3 outwards;
in vec2 uv_at_m;
flat in int material;

out vec4 colour;

#ifdef SHADOWS
uniform sampler2DShadow shadow_map;
uniform mat4x3 to_unit;  // to the inner square of the sun's view
uniform float wide;      // ratio of the wide square's side to the inner square's side
uniform vec4 squares;    // each square's fraction of the map's width and height
uniform vec2 texels;     // texel size of each square, as a fraction of the inner square's side
uniform float inner_m;

// Visible fraction of the sun, sampled two texels off the surface: the filter is three texels wide.
float sun_visibility(vec3 normal) {
    vec3 unit = to_unit * vec4(place_m, 1);
    vec3 off = mat3(to_unit) * normal * (2 * inner_m);
    vec3 narrow = unit + texels.x * off;
    vec3 broad = unit + texels.y * off;
    broad.xy = (broad.xy - 0.5) / wide + 0.5;
    bool inner = all(lessThan(abs(narrow.xy - 0.5), vec2(0.495)));
    vec3 at = inner ? vec3(narrow.xy * squares.xz, narrow.z)
                    : vec3(broad.xy * squares.yw + vec2(squares.x, 0), broad.z);
    vec2 texel = texels.x * squares.xz;
    float seen = texture(shadow_map, at + vec3(vec2(-1, -0.3) * texel, 0));
    seen += texture(shadow_map, at + vec3(vec2(0.75, -0.7) * texel, 0));
    seen += texture(shadow_map, at + vec3(vec2(0.25, 1) * texel, 0));
    bool covered = inner || all(lessThan(abs(broad.xy - 0.5), vec2(0.495)));
    return covered ? seen / 3 : 1;
}
#endif

#ifdef AMBIENT_OCCLUSION
uniform sampler3D occlusion;
uniform vec4 occlusion_frame;  // the lower corner, and 1 / side

// Visible fraction of the sky, sampled two cells off the surface to exclude the surface itself.
float sky_visibility(vec3 normal) {
    vec3 at = (place_m - occlusion_frame.xyz) * occlusion_frame.w + normal * (2.0 / CELLS);
    return 1 - texture(occlusion, at).r;
}
#endif

#ifdef RELIEF
// Bump-mapped normal (Mikkelsen, "Bump mapping unparametrized surfaces on the GPU", 2010).
vec3 bumped(vec3 normal, vec3 across, vec3 down, float height_m) {
    vec3 r = cross(down, normal), s = cross(normal, across);
    float size = dot(across, r);
    vec3 gradient = (dFdx(height_m) * r + dFdy(height_m) * s) / (abs(size) < 1e-12 ? 1e-12 : size);
    float steep = dot(gradient, gradient);
    return normalize(normal - gradient * inversesqrt(1 + steep));
}
#endif

// Reflected fraction of the light from a direction, relative to a white diffuse surface facing it.
vec3 reflected_share(vec3 light, vec3 normal, vec3 viewer, vec3 diffuse, vec3 mirror, float roughness) {
    float facing = max(dot(normal, light), 0);
#ifdef GLOSS
    // Cook and Torrance with GGX; Schlick's Fresnel and shadowing.
    vec3 halfway = normalize(light + viewer);
    float alpha = roughness * roughness;
    float peak = dot(normal, halfway);
    float spread = peak * peak * (alpha * alpha - 1) + 1;
    float k = alpha / 2;
    float seen = max(dot(normal, viewer), 0) * (1 - k) + k;
    float shaded = alpha * alpha / (4 * spread * spread * seen * (facing * (1 - k) + k));
    float grazing = 1 - max(dot(light, halfway), 0);
    float square = grazing * grazing;
    diffuse += (mirror + (1 - mirror) * square * square * grazing) * shaded;
#endif
    return diffuse * facing;
}

void main() {
    Material made = materials[material];
    vec4 texel = texture(textures, vec3(uv_at_m * made.repeats_per_m, made.layer));
    vec3 own = made.tint * texel.rgb * texel.rgb;

    // Turn normals towards the viewer, because sheets are two-sided.
    vec3 across = dFdx(place_m), down = dFdy(place_m);
    vec3 face = cross(across, down);
    vec3 away_m = place_m - eye_m;
    vec3 smooth_normal = normalize(outwards);
    smooth_normal *= dot(smooth_normal, face) * dot(face, away_m) > 0 ? -1 : 1;
    vec3 normal = smooth_normal;
#ifdef RELIEF
    normal = bumped(normal, across, down, texel.a * made.relief_m);
#endif

    float distance_m = length(away_m);
    vec3 viewer = -away_m / distance_m;
    float sunny = 1, open = 1;
#ifdef SHADOWS
    sunny = sun_visibility(smooth_normal);
#endif
#ifdef AMBIENT_OCCLUSION
    open = sky_visibility(smooth_normal);
#endif

    vec3 diffuse = own, mirror = vec3(0);
    float roughness = 1;
#ifdef GLOSS
    // Where the normal varies within a sample, widen the highlight to avoid sparkling (Tokuyoshi and Kaplanyan,
    // "Improved geometric specular antialiasing", 2019).
    vec3 turn_across = dFdx(normal), turn_down = dFdy(normal);
    float turn = 0.5 * (dot(turn_across, turn_across) + dot(turn_down, turn_down));
    roughness = max(made.roughness, 0.1);
    roughness = sqrt(sqrt(roughness * roughness * roughness * roughness + min(turn, 0.2)));
    diffuse = own * (1 - made.metal);
    // Porous surfaces (soil, leaves, chalk) have little specular reflection.
    mirror = mix(vec3(mix(0.05, 0.01, roughness)), own, made.metal);
#endif
    vec3 light = open * diffuse * sky_irradiance(normal);
#ifdef SUN
    light += sunny * sun_light * reflected_share(sun, normal, viewer, diffuse, mirror, roughness);
#endif
#if LAMPS > 0
    for (int k = 0; k < LAMPS; ++k) {
        vec3 towards_m = lamp_m[k] - place_m;
        float nearness = inversesqrt(dot(towards_m, towards_m));
        light += open * lamp_light[k] * nearness * nearness
               * reflected_share(towards_m * nearness, normal, viewer, diffuse, mirror, roughness);
    }
#endif
#ifdef GLOSS
    vec3 reflected = reflect(-viewer, normal);
    float grazing = 1 - max(dot(normal, viewer), 0);
    float square = grazing * grazing;
    vec3 share = mirror + (max(vec3(1 - roughness), mirror) - mirror) * square * square * grazing;
    light += open * share * mix(sky_radiance(reflected), sky_irradiance(reflected), roughness);
#endif
    light += made.glow * own;
#ifdef FOG
    light = mix(fog.rgb, light, exp(-fog.a * distance_m));
#endif
    colour = tone_mapped(light);
}
