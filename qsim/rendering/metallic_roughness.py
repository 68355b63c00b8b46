"""The surface of glTF 2.0 as a plugin of Mitsuba: a diffuse base under a dielectric coat, mixed with a metal.

    f = mix(base / pi * (1 - F) + F * D * G / (4 cos cos), F_metal * D * G / (4 cos cos), metallic)

and a second coat over both. F is Schlick's reflection at the half vector, D and G are those of GGX (Trowbridge and
Reitz) with alpha = roughness^2. Source: Khronos, glTF 2.0, appendix B, and KHR_materials_clearcoat. Both sides look
alike. Light that scatters between facets is left out, so rough metals are darker than real ones. Mitsuba's own
`principled` has Disney's base, which is brighter than a diffuse one.
"""

from __future__ import annotations

from typing import Any

NAME = "metallic_roughness"
LEAST_ALPHA = 1e-3  # of the facets; a mirror is drawn as this rough
COAT_REFLECTION = 0.04  # of the second coat at normal incidence, an index of 1.5

_registered: set[str] = set()


def register(mi: Any) -> None:
    """Make the plugin known to the present variant of Mitsuba."""
    variant = mi.variant()
    if variant in _registered:
        return
    mi.register_bsdf(NAME, _plugin(mi))
    _registered.add(variant)


def _plugin(mi: Any) -> Any:  # noqa: C901  a class per variant, whose methods are short
    """Return the class of the present variant."""
    import drjit as dr

    def facets(alpha: Any) -> Any:
        return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, dr.maximum(alpha, LEAST_ALPHA), True)

    def schlick(first: Any, cosine: Any) -> Any:
        return first + (1.0 - first) * dr.power(dr.clip(1.0 - cosine, 0.0, 1.0), 5.0)

    def glossy(lobe: Any, wi: Any, wo: Any, half: Any) -> Any:
        """Return D G / (4 cos cos) times the cosine of the outgoing direction."""
        return lobe.eval(half) * lobe.G(wi, wo, half) / (4.0 * dr.maximum(wi.z, 1e-6))

    class MetallicRoughness(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.base = props["base_color"]
            self.metallic = props["metallic"]
            self.roughness = props["roughness"]
            # Opaque: surfaces that differ in numbers alone share a kernel.
            self.reflection = dr.opaque(mi.Float, props.get("reflection", 0.04))
            self.coated = props.get("clearcoat", 0.0) > 0
            self.coat = dr.opaque(mi.Float, props.get("clearcoat", 0.0))
            self.coat_alpha = dr.opaque(mi.Float, props.get("clearcoat_alpha", LEAST_ALPHA))
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            spatial = mi.BSDFFlags.SpatiallyVarying
            diffuse = mi.BSDFFlags.DiffuseReflection | sides | spatial
            coat = mi.BSDFFlags.GlossyReflection | sides | spatial
            self.m_components = [diffuse, coat]
            self.m_flags = diffuse | coat

        def traverse(self, callback: Any) -> None:
            for name in ("base", "metallic", "roughness"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def _of(self, si: Any, active: Any) -> tuple[Any, Any, Any]:
            """Return base colour, metal and alpha at a point."""
            rough = self.roughness.eval_1(si, active)
            return self.base.eval(si, active), self.metallic.eval_1(si, active), rough * rough

        def _shares(self, base: Any, metal: Any) -> tuple[Any, Any]:
            """Return how often the second coat, and of the rest how often the facets, are sampled."""
            bright = dr.mean(base)
            first = self.reflection + (bright - self.reflection) * metal
            spread = bright * (1.0 - metal)
            # At grazing angles the coat reflects more than at normal incidence, so it never has less than a quarter.
            facet = dr.clip(first / dr.maximum(first + spread, 1e-4), 0.25, 1.0)
            facet = dr.select(spread < 1e-4, 1.0, facet)
            return 0.25 * self.coat, facet

        def _value(self, si: Any, wi: Any, wo: Any, active: Any) -> Any:
            base, metal, alpha = self._of(si, active)
            half = dr.normalize(wi + wo)
            cosine = dr.dot(wi, half)
            facet = glossy(facets(alpha), wi, wo, half)
            coat = schlick(self.reflection, cosine)
            # glTF 2.0, Appendix B.2: a dielectric is Lambertian below a Fresnel coat, a metal is
            # the coat alone with the base colour as its reflection; metal mixes both.
            first = (1.0 - coat) * base * dr.inv_pi * wo.z + coat * facet
            found = first + (schlick(base, cosine) * facet - first) * metal
            if self.coated:
                # KHR_materials_clearcoat: what the second coat reflects does not reach the layers below.
                seen = self.coat * schlick(COAT_REFLECTION, wi.z)
                second = glossy(facets(self.coat_alpha), wi, wo, half) * schlick(COAT_REFLECTION, cosine) * self.coat
                found = found * (1.0 - seen) + second
            return found

        def _density(self, si: Any, wi: Any, wo: Any, active: Any) -> Any:
            base, metal, alpha = self._of(si, active)
            second, facet = self._shares(base, metal)
            half = dr.normalize(wi + wo)
            # From the density of the half vector to that of the direction (Walter et al., EGSR 2007, eq. 14).
            turned = 1.0 / (4.0 * dr.maximum(dr.dot(wo, half), 1e-6))
            found = facet * facets(alpha).pdf(wi, half) * turned
            found += (1.0 - facet) * mi.warp.square_to_cosine_hemisphere_pdf(wo)
            if self.coated:
                found = found * (1.0 - second) + second * facets(self.coat_alpha).pdf(wi, half) * turned
            return found

        def _above(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any, Any]:
            """Return both directions on the side of the incoming one, and whether they are on the same."""
            side = dr.select(si.wi.z < 0, mi.Float(-1.0), mi.Float(1.0))
            wi = mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * side)
            mirrored = mi.Vector3f(wo.x, wo.y, wo.z * side)
            return wi, mirrored, active & (wi.z > 0) & (mirrored.z > 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            del ctx
            side = dr.select(si.wi.z < 0, mi.Float(-1.0), mi.Float(1.0))
            wi = mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * side)
            active = mi.Bool(active) & (wi.z > 0)
            base, metal, alpha = self._of(si, active)
            second, facet = self._shares(base, metal)
            shown = mi.Float(sample1)
            chosen = facets(alpha).sample(wi, sample2)[0]
            if self.coated:
                coated = shown < second
                chosen = dr.select(coated, facets(self.coat_alpha).sample(wi, sample2)[0], chosen)
                shown = (shown - second) / (1.0 - second)
            glossy_one = shown < facet  # also where the second coat was chosen: its share is below 0
            # Facets are mirrors: the chosen half vector reflects the incoming direction.
            reflected = 2.0 * dr.dot(wi, chosen) * mi.Vector3f(chosen) - wi
            wo = dr.select(glossy_one, reflected, mi.warp.square_to_cosine_hemisphere(sample2))
            active &= wo.z > 0
            bs = mi.BSDFSample3f()
            bs.wo = mi.Vector3f(wo.x, wo.y, wo.z * side)
            bs.pdf = self._density(si, wi, wo, active)
            bs.eta = 1.0
            bs.sampled_component = dr.select(glossy_one, mi.UInt32(1), mi.UInt32(0))
            bs.sampled_type = dr.select(
                glossy_one, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            active &= bs.pdf > 0
            value = self._value(si, wi, wo, active) / bs.pdf
            return bs, dr.select(active, value, 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            del ctx
            wi, mirrored, active = self._above(si, wo, active)
            return dr.select(active, self._value(si, wi, mirrored, active), 0.0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            del ctx
            wi, mirrored, active = self._above(si, wo, active)
            return dr.select(active, self._density(si, wi, mirrored, active), 0.0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            base, metal, _ = self._of(si, active)
            return base * (1.0 - metal)

        def to_string(self) -> str:
            return "MetallicRoughness[]"

    return MetallicRoughness
