"""Bones and cartilage from MR, in correspondence with motion capture.

Lengths are in millimetres and positions in LPS (x to the left, y to the back, z to the head) of the scanner, as their
names state. The sub-rooms in the order of the data:

- `space`: volumes, labels, grids and surfaces, and the geometry on them.
- `bones`: segmentation of femur, tibia and patella. `bones.segment_bones` calls five stages, each a frozen record from
  which the next one is computed: `located_bones` (prepared images, then seeds), `grown_bones`, `template_limits`,
  `refined_bones`. `settings.BoneSettings` contains the settings of all of them.
- `registration`: a template's bone to a subject's, rigid and elastic.
- `cartilage`: thickness of cartilage by a template and the image; `knee_cartilage` calls the others.
- `outlines`: outlines by hand with the live wire, and labels interpolated between them.
- `markers`: gadolinium markers in the scanner, and their correspondence to the laboratory; `correspondence` calls the
  others.
- `motion`: the joint in motion, and the proximity of its surfaces.
"""
