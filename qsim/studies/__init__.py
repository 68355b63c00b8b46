"""Studies the other rooms: bit depth against motion, and validation against independent references."""
