"""Synthetic cities with exactly known geometry.

`city` and `demo` are the simple box cities of `pcbench demo`: their clouds need no rendering. `pcbench synth` creates
the photographed city: `layout` creates its `plan` with the `buildings`; `surface` and `paint` add faces, textures and
light; `rigs` places cameras, `render` renders the images, and `truth` computes the true depths and surface. `warp`
deforms any cloud by a known amount.
"""

from pcbench.scenes.synthetic.demos import SIZE, City, Demo, Patches, city, demo, relief

__all__ = ["SIZE", "City", "Demo", "Patches", "city", "demo", "relief"]
