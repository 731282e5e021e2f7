// The picture's rectangle; `place` is (0, 0) at its upper left corner and (1, 1) at its lower right one.
attribute vec2 corner;
uniform mat4 matrix;
varying vec2 place;

void main() {
  place = corner;
  gl_Position = matrix * vec4(2.0 * corner.x - 1.0, 1.0 - 2.0 * corner.y, 0.0, 1.0);
}
