"""Pure functions of angles: Lambert, lobe, spike, masking, materials."""
