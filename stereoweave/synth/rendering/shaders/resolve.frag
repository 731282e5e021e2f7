// Averages the tone-mapped samples of a pixel and encodes the mean as sRGB.

uniform sampler2D samples;

out vec3 pixel;

void main() {
    ivec2 first = SAMPLES * ivec2(gl_FragCoord.xy);
    vec3 sum = vec3(0);
    for (int y = 0; y < SAMPLES; ++y) {
        for (int x = 0; x < SAMPLES; ++x) {
            vec3 root = texelFetch(samples, first + ivec2(x, y), 0).rgb;
            sum += root * root;
        }
    }
    vec3 light = sum / (SAMPLES * SAMPLES);
    pixel = mix(1.055 * pow(light, vec3(1 / 2.4)) - 0.055, 12.92 * light, lessThan(light, vec3(0.0031308)));
}
