"""From MR volumes to bones, cartilage and their motion."""
