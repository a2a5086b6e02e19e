"""Eye-dome lighting of points: what lies behind its surroundings in the picture is darker, which shows edges and depth.

VTK's `vtkEDLShading` darkens what lies in front of something further away. That blackens text, lines, and each dot of a
sparse cloud. Here, the scene is first drawn into an image of depths. Then the shader of each lit actor darkens a pixel
by how far it lies behind the mean of two opposite neighbours. A plane keeps its exact colours at any angle, and so does
a single dot; all other actors, text and the background do not change. Darkening multiplies red, green and blue by the
same factor, so that it keeps the hue.
"""

from __future__ import annotations

import math
from typing import Any

_STRENGTH = 0.6  # share of a colour's lightness that is lost where all neighbours lie far in front
_RADII_PX = (2.0, 5.0)  # distances of the neighbours
_ROUGHNESS_PX = 1.5  # depth behind the neighbours that is only the roundness of dots
_FULL_SLOPE = 3.0  # depth behind the neighbours, per distance in the picture, that darkens a pixel fully
_FUNCTIONS = """//VTK::Light::Dec
float distanceAt(float depth) {
  float span = depthRange.y - depthRange.x;
  if (isParallel > 0) return depthRange.x + depth * span;
  return depthRange.x * depthRange.y / (depthRange.y - depth * span);
}
"""
# VTK replaces the first line by its own computation of `fragOutput0`, and declares the texture `depths`.
_SHADING = f"""//VTK::Light::Impl
  if (strength > 0.0) {{
    vec2 texel = 1.0 / vec2(textureSize(depths, 0));
    vec2 place = gl_FragCoord.xy * texel;
    float here = distanceAt(texture(depths, place).r), behind = 0.0;
    float pixel = isParallel > 0 ? pixelSize : pixelSize * here;
    bool isHidden = distanceAt(gl_FragDepth) > here + {_ROUGHNESS_PX} * pixel;
    for (int k = 0; k < 8 && !isHidden; ++k) {{
      float angle = 0.7853981634 * float(k / 2), radius = k % 2 == 0 ? {_RADII_PX[0]} : {_RADII_PX[1]};
      vec2 step = radius * texel * vec2(cos(angle), sin(angle));
      float one = texture(depths, place + step).r, other = texture(depths, place - step).r;
      if (max(one, other) == 1.0) continue;  // the background is no neighbour
      float mean = 0.5 * (distanceAt(one) + distanceAt(other));
      behind += clamp(((here - mean) / pixel - {_ROUGHNESS_PX}) / ({_FULL_SLOPE} * radius), 0.0, 1.0) / 8.0;
    }}
    fragOutput0.rgb *= 1.0 - strength * behind;
  }}
"""


class Lighting:
    """The lighting of a plotter's scene; it affects the actors passed to `add`.

    Args:
        plotter: a `pyvista.Plotter` with one renderer.

    Attributes:
        enabled: whether the actors are lit; a change shows with the next rendering. Other passes of pyvista, such as
            those of `enable_anti_aliasing("ssaa")`, replace the lighting.
    """

    def __init__(self, plotter: Any) -> None:
        from vtkmodules.vtkRenderingOpenGL2 import (
            vtkFramebufferPass,
            vtkOpenGLShaderProperty,
            vtkOpenGLTexture,
            vtkOrderIndependentTranslucentPass,
            vtkRenderPassCollection,
            vtkRenderStepsPass,
            vtkSequencePass,
            vtkTranslucentPass,
        )

        self.enabled = True
        opaque, image = vtkRenderStepsPass(), vtkFramebufferPass()
        opaque.SetTranslucentPass(None)
        opaque.SetOverlayPass(None)
        image.SetDelegatePass(opaque)
        picture, translucent = vtkRenderStepsPass(), vtkOrderIndependentTranslucentPass()
        translucent.SetTranslucentPass(vtkTranslucentPass())  # as in a renderer without passes
        picture.SetTranslucentPass(translucent)
        passes = vtkRenderPassCollection()
        passes.AddItem(image)
        passes.AddItem(picture)
        self._pass = vtkSequencePass()
        self._pass.SetPasses(passes)
        self._depths = vtkOpenGLTexture()
        self._depths.SetTextureObject(image.GetDepthTexture())
        self._shader = vtkOpenGLShaderProperty()
        self._shader.AddFragmentShaderReplacement("//VTK::Light::Dec", True, _FUNCTIONS, False)
        self._shader.AddFragmentShaderReplacement("//VTK::Light::Impl", True, _SHADING, False)
        self._drawn = set[str]()  # addresses of the mappers that have drawn the depths of the current rendering
        plotter.renderer.SetPass(self._pass)
        plotter.renderer.AddObserver("StartEvent", self._set_uniforms)
        # Freed after each rendering, because a renderer that closes or gets another pass does not free them.
        plotter.renderer.AddObserver(
            "EndEvent", lambda renderer, _: image.ReleaseGraphicsResources(renderer.GetVTKWindow())
        )

    def add(self, actor: Any) -> None:
        """Light an opaque actor of points."""
        from vtkmodules.util.vtkConstants import VTK_OBJECT

        def skip_depths(mapper: Any, _: str, program: Any) -> None:
            """Do not light the first image, of which only the depths are used; that would take half of the time."""
            address = mapper.GetAddressAsString("")  # not the mapper, which would keep itself alive
            if address not in self._drawn:
                self._drawn.add(address)
                program.SetUniformf("strength", 0.0)

        skip_depths.CallDataType = VTK_OBJECT  # type: ignore[attr-defined]  # of the last argument
        actor.GetProperty().SetTexture("depths", self._depths)
        actor.SetShaderProperty(self._shader)
        actor.GetMapper().AddObserver("UpdateShaderEvent", skip_depths)

    def _set_uniforms(self, renderer: Any, _: str) -> None:
        """Pass the camera to the shader, before each rendering."""
        self._drawn.clear()
        camera, uniforms = renderer.GetActiveCamera(), self._shader.GetFragmentCustomUniforms()
        parallel, height = bool(camera.GetParallelProjection()), renderer.GetSize()[1]
        window = 2 * camera.GetParallelScale() if parallel else 2 * math.tan(math.radians(camera.GetViewAngle()) / 2)
        uniforms.SetUniformi("isParallel", int(parallel))
        uniforms.SetUniform2f("depthRange", camera.GetClippingRange())
        uniforms.SetUniformf("pixelSize", window / max(height, 1))
        uniforms.SetUniformf("strength", _STRENGTH if self.enabled and renderer.GetPass() is self._pass else 0.0)
