in float depth_m;
flat in float target;

out vec2 seen;

void main() {
    seen = vec2(depth_m, target);
}
