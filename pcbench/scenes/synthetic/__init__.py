"""Cities whose geometry is known exactly.

`city` and `demo` are the small boxes of `pcbench demo`: clouds of them cost no rendering. `pcbench synth` makes the
photographed one: `layout` makes its `plan` with the `buildings` in it, `surface` and `paint` give it faces, textures
and light, `rigs` places cameras, `render` takes the pictures and `truth` says what they show. `warp` bends any cloud by
a known amount.
"""

from pcbench.scenes.synthetic.demos import SIZE, City, Demo, Patches, city, demo, relief

__all__ = ["SIZE", "City", "Demo", "Patches", "city", "demo", "relief"]
