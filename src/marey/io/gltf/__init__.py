"""Characters and animations: glTF and BVH."""
