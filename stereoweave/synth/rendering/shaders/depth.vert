uniform mat4 projection;
uniform mat3 axes;
uniform vec3 eye_m;

in vec3 corner_m;
in int tag;

out float depth_m;
flat out float target;

void main() {
    vec3 seen_m = axes * (corner_m - eye_m);
    gl_Position = projection * vec4(seen_m, 1);
    depth_m = seen_m.z;
    target = float(tag / MATERIALS);
}
