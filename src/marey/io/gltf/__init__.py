"""Reading and writing characters and animations: glTF and BVH."""
