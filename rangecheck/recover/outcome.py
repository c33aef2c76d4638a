"""What a fit leaves behind: a material as every command takes it, with its uncertainties and what the pictures could not tell."""

from __future__ import annotations

from rangecheck.errors import SceneError
from rangecheck.recover.fit import Estimate, Fitted
from rangecheck.reflectance import Material


def material_of(fitted: Fitted, name: str = "fitted") -> tuple[Material, list[str]]:
    """The material that was found, at its wavelength, and what had to be assumed; spike and lobe share the strength that both have (K_s).

    A strength that the pictures do not determine, as of a highlight that is saturated, is at most what the surface does not send elsewhere. Raises
    SceneError where strengths that they do determine add to more than 1: then irradiance or exposure was not what it was taken to be."""
    guess, said = fitted.problem.material, []
    open_ones = {e.name for e in fitted.estimates if e.low is None}
    for mirrored in ("K_spike", "K_lobe"):
        most = max(0.0, 1.0 - guess.K_lm)
        if mirrored in open_ones and getattr(guess, mirrored) > most:
            guess = guess.but(**{mirrored: most})
            said.append(
                f"{mirrored} is taken to be {most:.4g}, the most that a surface can mirror beside K_lm; the pictures do not determine it"
            )
    both = min(guess.K_spike, guess.K_lobe)
    total = guess.K_lm + max(guess.K_spike, guess.K_lobe)
    if total > 1.0:
        raise SceneError(
            f"the strengths found add to {total:.3g}, and no surface reflects more than it receives: only their product with the light's "
            f"irradiance is in the pictures; give an irradiance at least {total:.3g} times as large",
            total=total,
        )
    material = Material(
        name, K_lm=guess.K_lm, K_ss=guess.K_spike - both, K_sl=guess.K_lobe - both, K_s=both, sigma_um=guess.sigma_um,
        correlation_um=guess.correlation_um, wavelengths_um=(guess.wavelength_um,), masking=guess.masking,
    )  # fmt: skip
    return material, said


def material_toml(material: Material, fitted: Fitted, source: str) -> str:
    """The material as a file for `load_material`; table `uncertainty` holds 95 % intervals and what is not determined."""
    lines = [
        f"description = {_text('Recovered from photographs by rangecheck fit')}",
        f"source = {_text(source)}",
        *(f"{key} = {float(getattr(material, key)):.9g}" for key in ("K_lm", "K_ss", "K_sl", "K_s")),
        f"sigma_um = {material.sigma_um:.9g}",
        f"correlation_um = {material.correlation_um:.9g}",
        f"wavelengths_um = [{material.wavelengths_um[0]:.9g}]",
        f"masking = {_text(material.masking)}",
        "",
        "[uncertainty]",
        f"residual_in_noises = {fitted.scale:.4g}",
        f"not_determined = [{', '.join(_text(said) for said in fitted.statements)}]",
    ]
    for e in fitted.estimates:
        if not e.name.startswith(("light", "picture", "camera")):
            lines.append(f"{e.name} = {_interval(e)}")
    return "\n".join(lines) + "\n"


def _interval(e: Estimate) -> str:
    return "[]" if e.low is None or e.high is None else f"[{e.low:.6g}, {e.high:.6g}]"


def _text(value: str) -> str:
    escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
