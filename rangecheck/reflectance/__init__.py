"""How surfaces reflect: Lambert, the Beckmann-Spizzichino lobe and spike, masking, Fresnel, energy, sampling, materials."""

from rangecheck.reflectance.material import COLOUR_UM, GREY_UM, Material, load_material, material_names, stack_tables
from rangecheck.reflectance.tables import MaterialTables

__all__ = [
    "COLOUR_UM",
    "GREY_UM",
    "Material",
    "MaterialTables",
    "load_material",
    "material_names",
    "stack_tables",
]
