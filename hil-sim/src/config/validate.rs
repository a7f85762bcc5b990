//! What a configuration must satisfy.

use super::{ClockMode, SimConfig, SurfaceConfig};
use crate::error::ConfigError;

impl SimConfig {
    /// Refuses what cannot be simulated; the error names the key and the limit.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let scene = &self.scene;
        let optics = &scene.optics;
        positive("scene.optics.wavelength_mm", optics.wavelength_mm)?;
        positive("scene.optics.focal_px", optics.focal_px)?;
        positive("scene.optics.pinhole_to_grating_mm", optics.pinhole_to_grating_mm)?;
        positive("scene.optics.grating_to_reference_mm", optics.grating_to_reference_mm)?;
        for (key, values) in
            [("scene.optics.brown_k", &optics.brown_k[..]), ("scene.optics.brown_p", &optics.brown_p[..])]
        {
            for &value in values {
                within(key, value, -10.0, 10.0)?;
            }
        }
        for grating in std::iter::once(&optics.grating).chain(&optics.grating_plus) {
            positive("scene.optics.grating.pitch_mm", grating.pitch_mm)?;
            if grating.pitch_mm <= optics.wavelength_mm {
                return Err(ConfigError::PitchBelowWavelength {
                    pitch_mm: grating.pitch_mm,
                    wavelength_mm: optics.wavelength_mm,
                });
            }
            for &angle in &grating.tilt_rad {
                within("scene.optics.grating.tilt_rad", angle, -0.5, 0.5)?;
            }
            within(
                "scene.optics.grating.substrate_mm",
                grating.substrate_mm,
                0.0,
                optics.grating_to_reference_mm,
            )?;
            within("scene.optics.grating.substrate_index", grating.substrate_index, 1.0, 4.0)?;
        }
        let mean = scene.microscope.as_ref().map_or(optics.wavelength_mm, |m| m.wavelength_mm);
        // Three full widths of a Gaussian stay above 0.
        within("scene.spectrum.width_mm", scene.spectrum.width_mm, 0.0, 0.5 * mean)?;
        within("scene.spectrum.samples", scene.spectrum.samples as f64, 0.0, 256.0)?;
        if let Some(microscope) = &scene.microscope {
            microscope.geometry(self.camera.width, self.camera.height).validate()?;
            for &side in &microscope.field_mm {
                within("scene.microscope.field_mm", side, 1e-6, 1e4)?;
            }
            within("scene.microscope.numerical_aperture", microscope.numerical_aperture, 0.0, 0.9)?;
            within("scene.microscope.focus_height_mm", microscope.focus_height_mm, -1.0, 1.0)?;
            within("scene.microscope.pupil_rings", microscope.pupil_rings as f64, 1.0, 8.0)?;
        }
        if let Some(lightfield) = &scene.lightfield {
            within("scene.lightfield.pitch_px", lightfield.pitch_px, 4.0, 500.0)?;
            within("scene.lightfield.rotation_rad", lightfield.rotation_rad, -0.5, 0.5)?;
            for &at in &lightfield.centre_px {
                within("scene.lightfield.centre_px", at, 0.0, 32_768.0)?;
            }
            let [from, to] = lightfield.depth_um;
            within("scene.lightfield.depth_um", to, from, from + 200.0)?;
            within("scene.lightfield.slide_mm", lightfield.slide_mm, 1e-3, 1e4)?;
            within("scene.lightfield.peak", lightfield.peak, 0.0, 100.0)?;
            within("scene.lightfield.radius", lightfield.radius as f64, 0.0, 16.0)?;
            for bead in &lightfield.beads {
                within("scene.lightfield.beads.diameter_um", bead.diameter_um, 0.1, 1e3)?;
                for &at in &bead.centre_um {
                    within("scene.lightfield.beads.centre_um", at, -1e4, 1e4)?;
                }
            }
            // more is beyond what one operator can hold
            let size = self.camera.width.max(self.camera.height) as f64;
            within("camera size over scene.lightfield.pitch_px", size / lightfield.pitch_px, 1.0, 200.0)?;
        }
        let specimen = &scene.specimen;
        within("scene.specimen.half_width_mm", specimen.half_width_mm, 1e-6, 1e4)?;
        within("scene.specimen.half_height_mm", specimen.half_height_mm, 1e-6, 1e4)?;
        for &value in &specimen.offset_mm {
            within("scene.specimen.offset_mm", value, -1e4, 1e4)?;
        }
        specimen.surface.validate()?;
        let texture = &scene.texture;
        let finest = specimen.half_width_mm.max(specimen.half_height_mm) / 4000.0;
        within("scene.texture.speckle_mm", texture.speckle_mm, finest, 1e4)?;
        within("scene.texture.density", texture.density, 0.0, 6.0)?;
        within("scene.texture.strength", texture.strength, 0.0, 100.0)?;
        within("scene.texture.contrast", texture.contrast, 0.0, 0.5)?;
        within(
            "scene.texture.mean_reflectance",
            texture.mean_reflectance,
            texture.contrast,
            1.0 - texture.contrast,
        )?;
        within("scene.samples", scene.samples as f64, 1.0, 4.0)?;
        within("scene.blur_step_px", scene.blur_step_px, 1e-3, 10.0)?;
        within("scene.blur_positions_max", scene.blur_positions_max as f64, 1.0, 4096.0)?;

        let camera = &self.camera;
        within("camera.width", camera.width as f64, 2.0, 32_768.0)?;
        within("camera.height", camera.height as f64, 1.0, 32_768.0)?;
        within(
            "camera.line",
            f64::from(camera.line),
            0.0,
            f64::from(daic_protocol::channels::CAMERAS) - 1.0,
        )?;
        within("camera.exposure_ns", camera.exposure_ns as f64, 8.0, 1e12)?;
        within("camera.trigger_delay_ns", camera.trigger_delay_ns as f64, 0.0, 1e12)?;
        within("camera.readout_ns", camera.readout_ns as f64, 0.0, 1e12)?;
        within("camera.row_ns", camera.row_ns as f64, 0.0, 1e9)?;
        for &share in camera.bayer.iter().flat_map(|b| &b.response) {
            within("camera.bayer.response", share, 0.0, 1.0)?;
        }
        within("camera.bits", f64::from(camera.bits), 8.0, 16.0)?;
        positive("camera.electrons_per_dn", camera.electrons_per_dn)?;
        positive("camera.full_well_electrons", camera.full_well_electrons)?;
        within("camera.offset_dn", camera.offset_dn, 0.0, f64::from((1u32 << camera.bits) - 1))?;
        within("camera.read_noise_electrons", camera.read_noise_electrons, 0.0, 1e6)?;
        within("camera.clock_drift_ppm", camera.clock_drift_ppm, -10_000.0, 10_000.0)?;
        for &rate in &self.light.led_electrons_per_s {
            within("light.led_electrons_per_s", rate, 0.0, 1e15)?;
        }
        within("light.ambient_electrons_per_s", self.light.ambient_electrons_per_s, 0.0, 1e15)?;
        for &steps in &self.stage.steps_per_mm {
            positive("stage.steps_per_mm", steps)?;
        }
        for &backlash in &self.stage.backlash_mm {
            within("stage.backlash_mm", backlash, 0.0, 10.0)?;
        }
        within(
            "board.axes (number)",
            self.board.axes.len() as f64,
            0.0,
            f64::from(daic_protocol::channels::AXES),
        )?;
        within(
            "board.leds (number)",
            self.board.leds.len() as f64,
            0.0,
            f64::from(daic_protocol::channels::LEDS),
        )?;
        within(
            "board.cameras",
            f64::from(self.board.cameras),
            0.0,
            f64::from(daic_protocol::channels::CAMERAS),
        )?;
        within(
            "board.inputs",
            f64::from(self.board.inputs),
            0.0,
            f64::from(daic_protocol::channels::INPUTS),
        )?;
        within("board.slots", f64::from(self.board.slots), 0.0, daic_protocol::limits::MAX_SLOTS as f64)?;
        if let Some(pair) = self.board.stimulus.windows(2).find(|p| p[1].tick < p[0].tick) {
            let (value, min) = (pair[1].tick as f64, pair[0].tick as f64);
            return Err(ConfigError::OutOfRange { key: "board.stimulus (tick)", value, min, max: f64::MAX });
        }
        match self.clock {
            ClockMode::Stepped { baud } => within("clock.baud", f64::from(baud), 300.0, 1e9),
            ClockMode::Wall { rate } => within("clock.rate", rate, 1e-6, 1e3),
        }
    }
}

impl SurfaceConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        let finite = |key, values: &[f64]| values.iter().try_for_each(|&v| within(key, v, -1e4, 1e4));
        match self {
            Self::Plane { height_mm, slope_x, slope_y } => {
                within("surface.height_mm", *height_mm, -1e4, 1e4)?;
                // Steeper planes would be seen edge-on by one of the views.
                within("surface.slope_x", *slope_x, -2.0, 2.0)?;
                within("surface.slope_y", *slope_y, -2.0, 2.0)
            }
            Self::Cylinder { radius_mm, apex_mm, floor_mm }
            | Self::Sphere { radius_mm, apex_mm, floor_mm } => {
                positive("surface.radius_mm", *radius_mm)?;
                finite("surface.apex_mm, floor_mm", &[*apex_mm, floor_mm.unwrap_or(0.0)])
            }
            Self::Cone { apex_mm, slope, floor_mm } => {
                within("surface.slope", *slope, 1e-9, 100.0)?;
                finite("surface.apex_mm, floor_mm", &[*apex_mm, floor_mm.unwrap_or(0.0)])
            }
            Self::Step { x_mm, low_mm, high_mm, direction_rad } => {
                finite("surface.x_mm, low_mm, high_mm", &[*x_mm, *low_mm, *high_mm])?;
                within("surface.direction_rad", *direction_rad, -4.0, 4.0)
            }
            Self::HeightMap { pixel_mm, black_mm, white_mm, .. } => {
                positive("surface.pixel_mm", *pixel_mm)?;
                finite("surface.black_mm, white_mm", &[*black_mm, *white_mm])
            }
        }
    }
}

fn positive(key: &'static str, value: f64) -> Result<(), ConfigError> {
    within(key, value, f64::MIN_POSITIVE, 1e15)
}

fn within(key: &'static str, value: f64, min: f64, max: f64) -> Result<(), ConfigError> {
    // Written so that NaN is refused too.
    if value >= min && value <= max { Ok(()) } else { Err(ConfigError::OutOfRange { key, value, min, max }) }
}
