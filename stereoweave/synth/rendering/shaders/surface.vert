uniform mat4 projection;
uniform mat3 axes;
uniform vec3 eye_m;

in vec3 corner_m;
in vec3 normal;
in vec2 uv_m;
in int tag;

out vec3 place_m;
out vec3 outwards;
out vec2 uv_at_m;
flat out int material;

void main() {
    gl_Position = projection * vec4(axes * (corner_m - eye_m), 1);
    place_m = corner_m;
    outwards = normal;
    uv_at_m = vec2(uv_m.x, -uv_m.y);  // the first row of a texture is its top
    material = tag % MATERIALS;
}
