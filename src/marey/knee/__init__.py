"""Bones and cartilage from MR, in correspondence with motion capture.

Lengths are the scanner's millimetres and positions LPS (x to the left, y to the back, z to the head), and their names
say so. The room in the order of the data:

- What is handled: `structures`, `volume`, `surface`, `sides`, `resampling`, `distances`.
- Bones: `bias_field`, `marrow`, `seeds`, `one_bone`, `region_growing`, `template_fit`, `partial_view`, `minimal_cut`,
  `bright_marrow`, `bone_edges`, `outer_edge`, `bone_notes`; `bones` calls them, `surfacing` gives surfaces.
- Outlines by hand: `boundary_elements`, `wire_tree`, `outlines`, `live_wire`, `outlining`, `contours`; `template` takes
  them or labels.
- A template's bone on a subject's: `mesh_repair`, `cut_ends`, `rigid_registration`, `registration_covariance`,
  `sided_registration`, `deformation`, `elastic_registration`.
- Cartilage: `cartilage_prediction`, `cartilage_evidence`, `cartilage_contact`, `cartilage_inner`, `cartilage`,
  `cartilage_labels`, `thickness`, `subregions`, on `mesh_graph` and `triangle_tree`; `knee_cartilage` calls them.
- Markers that scanner and laboratory see: `ball_candidates`, `ball_fit`, `gadolinium`; `marker_bones`,
  `marker_matching`, `marker_naming`, `anatomical_frames`, `reference_posture`, `marker_fit`; `correspondence` calls
  them.
- The joint in motion: `joint_motion`, `joint_surface`, `proximity`.
"""
