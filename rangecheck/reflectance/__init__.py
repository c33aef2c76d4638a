"""How surfaces reflect: Lambert, the Beckmann-Spizzichino lobe and spike, masking, Fresnel, energy, sampling, materials."""

from rangecheck.reflectance.brdf import (
    KirchhoffWarning,
    Scattering,
    directional_albedo,
    lobe_brdf,
    sample_scattering,
    spike_reflectance,
)
from rangecheck.reflectance.charts import energy_table, polar_chart
from rangecheck.reflectance.material import (
    COLOUR_UM,
    GREY_UM,
    Material,
    load_material,
    material_names,
    side_by_side,
    stack_tables,
)
from rangecheck.reflectance.tables import MaterialTables

__all__ = [
    "COLOUR_UM",
    "GREY_UM",
    "KirchhoffWarning",
    "Material",
    "MaterialTables",
    "Scattering",
    "directional_albedo",
    "energy_table",
    "load_material",
    "lobe_brdf",
    "material_names",
    "polar_chart",
    "sample_scattering",
    "side_by_side",
    "spike_reflectance",
    "stack_tables",
]
