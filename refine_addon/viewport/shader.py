"""Two shaders: one draws splats into a picture of their own, the other that picture into the view.
EWA splatting (Zwicker et al. 2002, Eq. 31) with the constants of the reference implementation.
Colours blend display-encoded, as in training; a view's framebuffer blends linear ones."""

from __future__ import annotations

from functools import cache

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from ..core.splats import ALPHA_CUT, ALPHA_MAX, DISC_LOW_PASS, LOW_PASS
from .arrays import SELECTED, SELECTED_SHARE, WIDTH

_CONSTANTS = f"""
#define WIDTH {WIDTH}
#define LOW_PASS {LOW_PASS}
#define DISC_LOW_PASS {DISC_LOW_PASS}
#define CROSSING 1e-3
#define THINNEST 1e-6
#define ALPHA_MAX {ALPHA_MAX}
#define ALPHA_CUT {ALPHA_CUT}
#define BEYOND 0.3
#define CENTER 1.5
#define RIM 0.7
#define SELECTED vec3{SELECTED}
#define SELECTED_SHARE {SELECTED_SHARE}
"""

_SPLAT_VERTEX = """
#define value_at(values, row) texelFetch(values, ivec2((row) % WIDTH, (row) / WIDTH), 0)

/* How the inverse of depths on the plane of a disc changes per pixel, in that of its centre. The
 * normal is what the covariance maps to 0: any column of its adjugate. */
vec2 tilt_of(mat3 covariance, vec3 seen, float depth, vec2 focal, vec3 x, vec3 y, vec3 z)
{
  mat3 unit = covariance / max(covariance[0][0] + covariance[1][1] + covariance[2][2], 1e-30);
  vec3 first = cross(unit[1], unit[2]);
  vec3 second = cross(unit[2], unit[0]);
  vec3 third = cross(unit[0], unit[1]);
  vec3 normal = dot(first, first) > dot(second, second) ? first : second;
  normal = dot(third, third) > dot(normal, normal) ? third : normal;
  vec3 turned = vec3(dot(cross(y, z), normal), dot(cross(z, x), normal), dot(cross(x, y), normal));
  float facing = dot(turned.xy, seen.xy / depth) - turned.z;
  return abs(facing) > 1e-6 * length(turned) ? turned.xy / (facing * focal) : vec2(0.0);
}

void main()
{
  int row = int(value_at(order, gl_InstanceID).r + 0.5);
  vec4 mean = value_at(means, row);
  vec4 upper = value_at(covariances, row);
  vec4 lower = value_at(more_covariances, row);
  int object = int(mean.w + 0.5);
  vec4 row_x = texelFetch(matrices, ivec2(0, object), 0);
  vec4 row_y = texelFetch(matrices, ivec2(1, object), 0);
  vec4 row_z = texelFetch(matrices, ivec2(2, object), 0);
  vec4 local = vec4(mean.xyz, 1.0);
  vec3 seen = vec3(dot(row_x, local), dot(row_y, local), dot(row_z, local));
  bool perspective = view_projection[3][3] == 0.0;
  float depth = -seen.z;
  paint = value_at(colors, row);
  float chosen = SELECTED_SHARE * step(0.5, value_at(selection, row).r);
  paint.rgb = mix(paint.rgb, SELECTED, chosen);
  bool disc = lower.z > 1.5;
  vec4 clip = view_projection * vec4(seen, 1.0);
  vec3 ndc = clip.xyz / clip.w;

  /* Gradients of column and row, px per unit of the object; slopes are clamped as in training. */
  vec2 scale = 0.5 * view_data.xy;
  vec2 focal = vec2(view_projection[0][0], view_projection[1][1]);
  vec3 to_column = focal.x * scale.x * row_x.xyz;
  vec3 to_row = focal.y * scale.y * row_y.xyz;
  if (perspective) {
    vec2 middle = vec2(view_projection[2][0], view_projection[2][1]);
    vec2 most = vec2(1.0 + BEYOND);
    vec2 slope = clamp(seen.xy / depth, (middle - most) / focal, (middle + most) / focal);
    slope = disc ? seen.xy / depth : slope;
    to_column = focal.x * scale.x / depth * (row_x.xyz + slope.x * row_z.xyz);
    to_row = focal.y * scale.y / depth * (row_y.xyz + slope.y * row_z.xyz);
  }
  mat3 shape = mat3(upper.x, upper.y, upper.z,
                    upper.y, upper.w, lower.x,
                    upper.z, lower.x, lower.y);
  vec3 along_column = shape * to_column;
  float xx = dot(to_column, along_column);
  float xy = dot(to_row, along_column);
  float yy = dot(to_row, shape * to_row);
  float sharp = max(xx * yy - xy * xy, 0.0);
  if (!disc) {
    xx += LOW_PASS;
    yy += LOW_PASS;
    paint.a *= lower.z > 0.5 ? sqrt(sharp / (xx * yy - xy * xy)) : 1.0;
  }
  float reach = 2.0 * log(paint.a / ALPHA_CUT);
  bool shown = depth > view_data.z && reach > 0.0;
  reach = view_data.w > 0.5 ? 1.0 : reach;
  if (view_data.w > 1.5) {
    disc = false;
    xx = CENTER * CENTER;
    xy = 0.0;
    yy = xx;
  }

  /* Axes of the ellipse: eigenvectors times standard deviations. */
  float mean_square = 0.5 * (xx + yy);
  float radius = length(vec2(0.5 * (xx - yy), xy));
  float longest = mean_square + radius;
  float shortest = disc ? sharp / max(longest, 1e-30) : (xx * yy - xy * xy) / longest;
  float thinnest = disc ? THINNEST : 0.0;
  longest = max(longest, thinnest);
  shortest = max(shortest, thinnest);
  shown = shown && shortest > 0.0 && longest <= 1e12;
  vec2 direction = xx > yy ? vec2(longest - yy, xy) : vec2(xy, longest - xx);
  direction = radius > 1e-6 * mean_square ? normalize(direction) : vec2(1.0, 0.0);
  vec2 along = sqrt(longest) * direction;
  vec2 beside = sqrt(shortest) * vec2(-direction.y, direction.x);
  place = corner * sqrt(reach);
  vec2 offset = place.x * along + place.y * beside;
  axes = vec4(0.0);
  plane = vec4(0.0);
  if (disc) {
    /* The ray meets the plane of the disc: see core/visibility/projection.py, _discs. */
    axes = vec4(along / longest, beside / shortest);
    plane = vec4(0.0, 0.0, 1e9, 1.0);
    if (perspective) {
      plane.xy = tilt_of(shape, seen, depth, focal * scale, row_x.xyz, row_y.xyz, row_z.xyz);
      plane.z = depth / view_data.z;
    }
    /* The box of its edge: see core/visibility/cast.py, _disc_extent. */
    vec2 tilted = vec2(dot(along, plane.xy), dot(beside, plane.xy));
    float left = 1.0 - reach * dot(tilted, tilted);
    vec2 low = -view_data.xy;
    vec2 high = view_data.xy;
    if (left > CROSSING) {
      float share = reach / left;
      vec2 shift = tilted.x * along + tilted.y * beside;
      vec2 edge = sqrt(share * (along * along + beside * beside + share * shift * shift));
      vec2 least = vec2(sqrt(reach * DISC_LOW_PASS));
      low = min(share * shift - edge, -least);
      high = max(share * shift + edge, least);
    }
    offset = mix(low, high, 0.5 * corner + 0.5);
    place = offset;
  }
  gl_Position = shown ? vec4(ndc.xy + offset / scale, ndc.z, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}
"""

_SPLAT_FRAGMENT = """
void main()
{
  float square = dot(place, place);
  if (plane.w > 0.5) {
    float nearer = 1.0 + dot(plane.xy, place);
    vec2 hit = vec2(dot(axes.xy, place), dot(axes.zw, place)) / max(nearer, 1e-4);
    float blob = square / DISC_LOW_PASS;
    bool on_plane = nearer > 1e-4 && dot(hit, hit) <= blob;
    square = !on_plane ? blob : nearer > plane.z ? 1e9 : dot(hit, hit);
  }
  float alpha = min(ALPHA_MAX, paint.a * exp(-0.5 * square));
  vec3 shade = paint.rgb;
  if (view_data.w > 0.5) {
    alpha = square > 1.0 ? 0.0 : 1.0;
    shade *= view_data.w < 1.5 && square > RIM ? 0.5 : 1.0;
  }
  if (alpha < ALPHA_CUT) {
    discard;
  }
  ivec2 texel = min(ivec2(gl_FragCoord.xy * view_hides.x), textureSize(depths, 0) - 1);
  bool hidden = view_hides.x > 0.0 && gl_FragCoord.z > texelFetch(depths, texel, 0).r;
  if (view_hides.y > 0.0) {
    hidden = hidden || gl_FragCoord.z <= texelFetch(near_depths, ivec2(gl_FragCoord.xy), 0).r;
  }
  if (hidden) {
    discard;
  }
  color = vec4(shade * alpha, alpha);
}
"""

_PICTURE_VERTEX = """
void main()
{
  place = 0.5 * corner + 0.5;
  gl_Position = vec4(corner, 0.0, 1.0);
}
"""

# Linear colours: the view's framebuffer encodes them by the sRGB curve (IEC 61966-2-1).
_PICTURE_FRAGMENT = """
void main()
{
  ivec2 size = textureSize(picture, 0);
  vec2 at = clamp(place * vec2(size) - 0.5, vec2(0.0), vec2(size) - 1.0);
  ivec2 low = ivec2(at);
  ivec2 high = min(low + 1, size - 1);
  vec2 share = at - vec2(low);
  vec4 mixed = mix(
      mix(texelFetch(picture, low, 0), texelFetch(picture, ivec2(high.x, low.y), 0), share.x),
      mix(texelFetch(picture, ivec2(low.x, high.y), 0), texelFetch(picture, high, 0), share.x),
      share.y);
  vec3 shown = clamp(mixed.rgb, 0.0, 1.0);
  vec3 curved = pow((shown + 0.055) / 1.055, vec3(2.4));
  color = vec4(mix(shown / 12.92, curved, step(vec3(0.04045), shown)), mixed.a);
}
"""


_PROGRAMS = {
    "splats": (
        "order means covariances more_covariances colors selection matrices depths near_depths",
        "paint axes plane",
        _SPLAT_VERTEX,
        _SPLAT_FRAGMENT,
    ),
    "picture": ("picture", "", _PICTURE_VERTEX, _PICTURE_FRAGMENT),
}
"""Textures, what vertices give to fragments besides ``place``, and sources. "splats" draws a quad
for each splat, "picture" one that covers the view."""


def texture(values: NDArray[np.float32], channels: int, kind: str) -> gpu.types.GPUTexture:
    """Values, (R, C * channels), as texels on the graphics card."""
    size = (values.shape[1] // channels, values.shape[0])
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    return gpu.types.GPUTexture(size, format=kind, data=gpu.types.Buffer("FLOAT", len(flat), flat))


@cache
def program(name: str) -> tuple[gpu.types.GPUShader, gpu.types.GPUBatch]:
    """One of `_PROGRAMS`, kept until its cache is cleared, and its quad."""
    samplers, flat, vertex, fragment = _PROGRAMS[name]
    info = gpu.types.GPUShaderCreateInfo()
    info.typedef_source(_CONSTANTS)
    info.push_constant("MAT4", "view_projection")
    info.push_constant("VEC4", "view_data")  # pixels across, pixels up, near plane, style
    info.push_constant("VEC2", "view_hides")  # texels per pixel of each end's depths, 0 without
    for slot, sampler in enumerate(samplers.split()):
        info.sampler(slot, "FLOAT_2D", sampler)
    between = gpu.types.GPUStageInterfaceInfo(f"refine_{name}")
    between.smooth("VEC2", "place")
    for value in flat.split():
        between.flat("VEC4", value)
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "color")
    info.vertex_source(vertex)
    info.fragment_source(fragment)
    compiled = gpu.shader.create_from_info(info)
    corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]
    return compiled, batch_for_shader(compiled, "TRI_STRIP", {"corner": corners})


def blend(
    picture: gpu.types.GPUTexture,
    textures: dict[str, gpu.types.GPUTexture],
    projection: NDArray[np.float64],
    near: float,
    count: int,
    style: int = 0,
) -> gpu.types.GPUFrameBuffer:
    """Clear a picture and draw `count` splats. `textures`: inputs of the shader, held by
    the caller until drawn; without "depths" or "near_depths" these hide nothing. `near`: depth of
    the near plane; `style`: 0 splats, 1 their ellipses, 2 their centres."""
    ends = dict.fromkeys(("depths", "near_depths"), texture(np.ones((1, 1)), 1, "R32F"))
    hides = [textures[name].width / picture.width if name in textures else 0.0 for name in ends]
    frame = gpu.types.GPUFrameBuffer(color_slots=picture)
    with frame.bind():
        frame.clear(color=(0.0, 0.0, 0.0, 0.0))
        if count:
            splats, quad = program("splats")
            gpu.state.blend_set("ALPHA_PREMULT")
            gpu.state.depth_test_set("NONE")
            splats.bind()
            splats.uniform_float("view_projection", projection.T.ravel())
            splats.uniform_float("view_data", (picture.width, picture.height, near, style))
            splats.uniform_float("view_hides", hides)
            for name, values in (ends | textures).items():
                splats.uniform_sampler(name, values)
            quad.draw_instanced(splats, instance_count=count)
            gpu.state.blend_set("NONE")
    return frame
