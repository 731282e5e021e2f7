uniform mat4x3 to_unit;

in vec3 corner_m;

void main() {
    gl_Position = vec4(2 * (to_unit * vec4(corner_m, 1)) - 1, 1);
}
