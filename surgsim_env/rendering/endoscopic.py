"""Endoscopic style: shading programs for MuJoCo's drawing, wet tissue under one lamp beside the camera.

MuJoCo draws with OpenGL's fixed shading; a program that is current while it draws replaces it. Meshes tell the program
what they are by the lengths of their normals: 1 as usual; TISSUE_LENGTH and more for tissue, with its resting place in
the texture coordinates and the rest of the length [m]. The abdomen's are described by `abdomen.abdomen`.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

from surgsim_env.rendering.gl import NoGLError
from surgsim_env.rendering.vessels import tissue_field

TISSUE_LENGTH = 10.0
# Texture unit of the field, beyond those that MuJoCo uses.
UNIT = 3

VERTEX = """#version 120
varying vec3 place, normal, world, carried;
varying float tissue;
void main() {
    float size = length(gl_Normal);
    tissue = step(5.0, size);
    place = (gl_ModelViewMatrix * gl_Vertex).xyz;
    normal = gl_NormalMatrix * gl_Normal;
    world = gl_Vertex.xyz;
    carried = vec3(gl_MultiTexCoord0.xy, size - 10.0);
    gl_Position = gl_ModelViewProjectionMatrix * gl_Vertex;
}
"""

COMMON = """#version 120
uniform sampler3D field;
// Distance of the aim [m], and one over width and height of the picture [pixels].
uniform vec3 view;
varying vec3 place, normal, world, carried;
varying float tissue;

// Turned, so that no surface lies along the field's repeats.
const mat3 TURN = mat3(0.64, 0.48, 0.60, -0.60, 0.80, 0.0, -0.48, -0.36, 0.80);

// The field's gradient and value at a point [m], with waves of a length [m].
vec4 waves(vec3 point, float length) { return 2.0 * texture3D(field, TURN * point * (0.125 / length)) - 1.0; }

// A normal bent by a gradient of the field.
vec3 bent(vec3 straight, vec3 gradient) { return normalize(straight - gl_NormalMatrix * (gradient * TURN)); }

// Colour of a surface under the lamp: of its matt part, with a smooth and a wet normal.
vec4 lit(vec3 matt, vec3 smooth_normal, vec3 wet, float gloss, float sharpness, float wrap, float shade) {
    vec3 eye = normalize(-place), to_lamp = view.x * vec3(-0.22, 0.26, 0.0) - place, light = normalize(to_lamp);
    // Light that enters tissue leaves it red.
    vec3 spread = wrap * vec3(1.0, 0.35, 0.25);
    vec3 colour = matt * (2.1 * max((dot(smooth_normal, light) + spread) / (1.0 + wrap), 0.0) + 0.10);
    float mirrored = max(dot(wet, normalize(light + eye)), 0.0), grazing = 1.0 - max(dot(smooth_normal, eye), 0.0);
    grazing *= grazing;
    colour += gloss * (2.2 * pow(mirrored, sharpness) + 0.14 * grazing * grazing);
    // The light falls off with the square of the distance; 1 at the aim.
    colour *= shade * view.x * view.x / dot(to_lamp, to_lamp);
    colour += gl_FrontMaterial.emission.rgb * matt;
    vec2 off = gl_FragCoord.xy * view.yz - 0.5;
    colour *= 1.0 - 1.15 * dot(off, off);
    // A camera approaches white and does not clip it. The last entry becomes the covered share of a pixel.
    return vec4(sqrt(1.0 - exp(-1.5 * colour)), 1.0);
}
"""

TISSUE = """
void main() {
    vec3 straight = normalize(normal), matt = gl_FrontMaterial.diffuse.rgb;
    matt *= matt;
    vec4 coarse = waves(carried, 0.011), fine = waves(carried, 0.0022);
    float line = 1.0 - smoothstep(0.0, 0.05, abs(coarse.a + 0.2 * fine.a));
    vec3 flesh = 0.85 * matt + vec3(0.060, 0.026, 0.020);
    flesh *= 1.0 + 0.50 * coarse.b + 0.16 * fine.a;
    flesh *= 1.0 - vec3(0.30, 0.50, 0.40) * line * smoothstep(-0.1, 0.3, coarse.r);
    vec3 wet = bent(straight, tissue * (0.06 * coarse.rgb + 0.17 * fine.rgb));
    // Metal mirrors the red around it.
    float gloss = gl_FrontMaterial.specular.r;
    vec3 metal = matt * mix(vec3(0.75), vec3(0.42, 0.36, 0.35), gloss);
    gl_FragColor = lit(
        mix(metal, flesh, tissue), straight, wet,
        mix(gloss, 0.9, tissue), mix(40.0, 180.0, tissue), 0.25 * tissue, 1.0
    );
}
"""

SCENERY = """
vec3 scattered(vec3 cell) {
    return fract(sin(vec3(dot(cell, vec3(127.1, 311.7, 74.7)), dot(cell, vec3(269.5, 183.3, 246.1)),
                          dot(cell, vec3(113.5, 271.9, 124.6)))) * 43758.5453);
}

// Way from the nearest of scattered points, and in .w how much farther the second is.
vec4 lobule(vec3 at) {
    vec3 corner = floor(at - 0.5), nearest = vec3(0.0);
    float first = 9.0, second = 9.0;
    for (int k = 0; k < 8; k++) {
        vec3 cell = corner + vec3(mod(float(k), 2.0), mod(floor(0.5 * float(k)), 2.0), floor(0.25 * float(k)));
        vec3 way = at - cell - 0.15 - 0.7 * scattered(cell);
        float far = dot(way, way);
        if (far < first) { second = first; first = far; nearest = way; } else second = min(second, far);
    }
    return vec4(nearest, sqrt(second) - sqrt(first));
}

void main() {
    vec3 straight = normalize(normal);
    vec4 mottle = waves(world, 0.037), coarse = waves(world, 0.012), fine = waves(world, 0.0025);
    vec3 at = TURN * (world + 0.0035 * coarse.rgb);
    vec4 large = lobule(at / 0.014), small = lobule(at / 0.006);
    float valley = smoothstep(0.0, 0.40, large.w) * (0.75 + 0.25 * smoothstep(0.0, 0.4, small.w));
    vec3 fat = mix(vec3(0.60, 0.31, 0.12), vec3(0.76, 0.50, 0.21), valley) * (1.0 + 0.35 * mottle.a);
    fat = mix(fat, vec3(0.58, 0.20, 0.12), 0.7 * smoothstep(0.05, 0.5, mottle.b));
    fat = mix(fat, vec3(0.42, 0.07, 0.05), 0.55 * (1.0 - smoothstep(0.0, 0.03, abs(mottle.a + 0.2 * coarse.a))));
    vec3 bowel = mix(vec3(0.60, 0.20, 0.15), vec3(0.68, 0.30, 0.22), 0.5 + mottle.a);
    vec3 wall = mix(vec3(0.40, 0.10, 0.075), vec3(0.52, 0.17, 0.12), 0.5 + mottle.a);
    float line = 1.0 - smoothstep(0.0, 0.045, abs(mottle.a + 0.12 * coarse.a));
    vec3 thin = mix(wall, bowel, carried.y) * (1.0 - vec3(0.12, 0.25, 0.22) * line);
    vec3 hill = 0.50 * large.xyz * (1.0 - 0.5 * valley) + 0.22 * small.xyz;
    vec3 round_normal = bent(straight, mix(0.07 * coarse.rgb, -hill * carried.x, carried.x));
    vec3 wet = bent(round_normal, 0.10 * fine.rgb);
    gl_FragColor = lit(mix(thin, fat, carried.x), round_normal, wet, 0.35, 60.0, 0.25, 0.12 + 0.88 * carried.z);
}
"""


class EndoscopicShading:
    """Shading programs and field of tissue in the current graphics context, for pictures of one size."""

    def __init__(self, width: int, height: int) -> None:
        """Compile the programs for a size [pixels] and load the field.

        Raises:
            NoGLError: this OpenGL cannot.
        """
        from OpenGL import GL

        self._gl, self._size = GL, (width, height)
        self._programs: dict[str, Any] = {name: self._compile(source) for name, source in PROGRAMS.items()}
        values = tissue_field()
        self._field = GL.glGenTextures(1)
        GL.glBindTexture(GL.GL_TEXTURE_3D, self._field)
        for name in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
            GL.glTexParameteri(GL.GL_TEXTURE_3D, name, GL.GL_LINEAR)
        kind = GL.GL_RGBA, GL.GL_UNSIGNED_BYTE
        GL.glTexImage3D(GL.GL_TEXTURE_3D, 0, GL.GL_RGBA8, *values.shape[:3], 0, *kind, values)

    @contextlib.contextmanager
    def used(self, name: str, distance: float) -> Iterator[None]:
        """Shade what is drawn within the block by a program, seen by a camera aimed at a distance [m]."""
        gl, program = self._gl, self._programs[name]
        # Other stages of the context have fields of their own.
        gl.glActiveTexture(gl.GL_TEXTURE0 + UNIT)
        gl.glBindTexture(gl.GL_TEXTURE_3D, self._field)
        gl.glActiveTexture(gl.GL_TEXTURE0)
        gl.glUseProgram(program)
        gl.glUniform1i(gl.glGetUniformLocation(program, b"field"), UNIT)
        gl.glUniform3f(gl.glGetUniformLocation(program, b"view"), distance, *(1.0 / side for side in self._size))
        try:
            yield
        finally:
            gl.glUseProgram(0)

    def free(self) -> None:
        """Free the programs and the field."""
        for program in self._programs.values():
            self._gl.glDeleteProgram(program)
        self._gl.glDeleteTextures([self._field])

    def _compile(self, fragment: str) -> Any:
        gl = self._gl
        program = gl.glCreateProgram()
        for kind, source in ((gl.GL_VERTEX_SHADER, VERTEX), (gl.GL_FRAGMENT_SHADER, fragment)):
            shader = gl.glCreateShader(kind)
            gl.glShaderSource(shader, source)
            gl.glCompileShader(shader)
            gl.glAttachShader(program, shader)
            gl.glDeleteShader(shader)
        gl.glLinkProgram(program)
        if not gl.glGetProgramiv(program, gl.GL_LINK_STATUS):
            raise NoGLError('OpenGL has no shading language 1.20 for style="endoscopic": use style="plain"')
        return program


PROGRAMS = {"tissue": COMMON + TISSUE, "scenery": COMMON + SCENERY}
