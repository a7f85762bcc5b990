//! What the frames show follows from the edges alone.

mod support;

use std::time::Duration;

use daic_hil_sim::config::SurfaceConfig;
use daic_hil_sim::{SimConfig, SimFrame, SimRig, Transport};
use daic_protocol::program::Instruction;
use support::*;

fn host(rig: &SimRig) -> Host<daic_hil_sim::DuplexEnd> {
    Host::new(rig.connect().expect("in-process"))
}

/// All frames of a program.
fn frames(config: SimConfig, program: &[Instruction]) -> (SimRig, Vec<SimFrame>) {
    let rig = SimRig::start(config, Transport::InProcess).expect("starts");
    host(&rig).run(program);
    let mut frames = Vec::new();
    loop {
        // Read before the stream: once it is 0 all frames are there.
        let all_there = rig.frames_in_work() == 0;
        match rig.next_frame(Duration::from_millis(if all_there { 0 } else { 50 })) {
            Ok(frame) => frames.push(frame),
            Err(_) if all_there => break,
            Err(_) => {}
        }
    }
    (rig, frames)
}

fn program(parts: &[&[Instruction]]) -> Vec<Instruction> {
    parts.iter().flat_map(|part| part.iter().copied()).collect()
}

fn mean(frame: &SimFrame) -> f64 {
    frame.data.iter().map(|&v| f64::from(v)).sum::<f64>() / frame.data.len() as f64
}

#[test]
fn strobe_within_the_exposure_lights_the_frame_and_one_too_late_leaves_it_dark() {
    // Exposure 5 µs … 1005 µs after the trigger.
    let config = noiseless(small());
    let offset = config.camera.offset_dn;
    let parts = program(&[&level(u16::MAX), &strobed(100, 100), &strobed(1100, 100)]);
    let (_, frames) = frames(config, &parts);
    assert_eq!(frames.len(), 2);
    assert!(mean(&frames[0]) > offset + 100.0, "{}", mean(&frames[0]));
    assert!(frames[1].data.iter().all(|&v| f64::from(v) == offset));
    assert_eq!((frames[1].truth.electrons, frames[1].truth.stage_mm), (0.0, None));
}

#[test]
fn only_the_part_of_a_pulse_within_the_exposure_counts() {
    // 9e7 e/s at full level. The exposure ends 1005 µs after the trigger, so of the strobe from
    // 955 to 1055 µs half is seen; of one from 0 to 10 µs (delay 5 µs) half as well.
    let electrons = |program: &[Instruction]| {
        let (_, frames) = frames(noiseless(small()), program);
        frames.iter().map(|f| f.truth.electrons).collect::<Vec<_>>()
    };
    let early = [
        set(camera() | led(), 1000),
        clear(led(), 10 * US),
        clear(camera(), US),
        Instruction::Delay { ticks: 15_000 * US },
    ];
    let got = electrons(&program(&[&level(u16::MAX), &strobed(955, 100), &early]));
    assert_eq!(got.len(), 2);
    assert!((got[0] - 9.0e7 * 50e-6).abs() < 1e-6, "{got:?}");
    assert!((got[1] - 9.0e7 * 5e-6).abs() < 1e-6, "{got:?}");
}

#[test]
fn signal_is_proportional_to_the_level() {
    let config = noiseless(small());
    let offset = config.camera.offset_dn;
    let parts = program(&[&level(u16::MAX), &strobed(100, 80), &level(u16::MAX / 4), &strobed(100, 80)]);
    let (_, frames) = frames(config, &parts);
    let ratio = (mean(&frames[1]) - offset) / (mean(&frames[0]) - offset);
    let commanded = f64::from(u16::MAX / 4) / f64::from(u16::MAX);
    // Rounding to counts: 1/√12 per pixel over 3e4 lit pixels of about 1400 counts, 1.2e-6; measured 3e-6.
    assert!((ratio - commanded).abs() < 2e-5, "{ratio} {commanded}");
}

#[test]
fn triggers_while_busy_are_missed_and_counted() {
    // Busy for 5 + 1000 + 10 000 µs.
    let pulse = |after_us: u32| [set(camera(), after_us * US), clear(camera(), 10 * US)];
    let parts =
        program(&[&pulse(10), &pulse(500), &pulse(5000), &pulse(6000), &[Instruction::Delay { ticks: 100 }]]);
    let (rig, frames) = frames(small(), &parts);
    // Edges at 0, 510, 5520 µs (both missed) and 11 530 µs.
    assert_eq!(frames.iter().map(|f| f.id).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(rig.truth().missed_triggers, 2);
    let gap = frames[1].truth.trigger_tick - frames[0].truth.trigger_tick;
    assert_eq!(gap, u64::from((510 + 5010 + 6010) * US));
    // The camera's clock gains 12.5 ppm on the box's.
    let gap_ns = (frames[1].camera_ns - frames[0].camera_ns) as f64;
    assert!((gap_ns - gap as f64 * 8.0 * (1.0 + 12.5e-6)).abs() <= 1.0, "{gap_ns}");
}

#[test]
fn stage_stands_where_the_pulses_put_it() {
    let parts =
        program(&[&level(u16::MAX), &[go(0, 320), go(1, -192), go(2, 1280), go(0, 100)], &strobed(100, 50)]);
    let (rig, frames) = frames(noiseless(small()), &parts);
    let expected = [100.0 / 6400.0, -192.0 / 6400.0, 1280.0 / 6400.0];
    assert_eq!(rig.truth().stage_mm, expected);
    assert_eq!(frames[0].truth.stage_mm, Some(expected));
    assert_eq!(frames[0].truth.positions, 1);
}

/// A bare white specimen that moves by W during the strobe: its edge becomes a ramp of width W.
#[test]
fn moving_stage_blurs_by_the_path_travelled_while_lit() {
    let mut config = noiseless(small());
    config.scene.texture.contrast = 0.0;
    config.scene.samples = 4;
    config.scene.specimen.surface = SurfaceConfig::default();
    config.camera.exposure_ns = 200_000_000;
    config.board.leds.iter_mut().for_each(|l| l.max_pulse = u32::MAX);
    config.light.led_electrons_per_s = vec![9.0e4];
    // To the left, so that the specimen still reaches beyond the sensor on its other side: 1 mm.
    let steps = 6400;
    let moving = [
        set(camera(), 1000),
        set(led(), 100 * US),
        Instruction::Move { axis: 0, target: -steps, max_rate: 64_000, acceleration: 1_280_000, jerk: 0 },
        clear(led(), 10),
        clear(camera(), US),
    ];
    let pause = [Instruction::Delay { ticks: 300_000 * US }];
    let parts = program(&[&level(u16::MAX), &strobed(100, 100_000), &pause, &moving, &pause]);
    let (rig, frames) = frames(config.clone(), &parts);
    assert_eq!(frames.len(), 2);
    assert_eq!(frames[0].truth.positions, 1);
    // 1 mm in steps of at most 0.1 px of (307 + 109) mm · 8 / 17 956.2.
    let step_mm = 0.1 * 416.0 / config.scene.optics.focal_px;
    let positions = frames[1].truth.positions as f64;
    assert!(positions >= 1.0 / step_mm && positions < 1.02 / step_mm + 1.0, "{positions} {}", 1.0 / step_mm);
    // Where it was on average follows from the step pulses and the time the LED was on.
    let led_ticks = |on: bool| {
        let lit: Vec<u64> = rig
            .played()
            .windows(2)
            .filter(|w| (w[1].1 & led() != 0) == on && (w[0].1 & led() != 0) != on)
            .map(|w| w[1].0)
            .collect();
        lit[1]
    };
    let (on, off) = (led_ticks(true), led_ticks(false));
    let step = daic_protocol::channels::step(0).expect("there");
    let rises: Vec<u64> =
        rig.played().windows(2).filter(|w| w[1].1 & !w[0].1 & step != 0).map(|w| w[1].0).collect();
    assert_eq!(rises.len(), steps as usize);
    let mean_mm = -rises.iter().map(|&t| (off - t) as f64).sum::<f64>() / (off - on) as f64 / 6400.0;
    let truth = frames[1].truth.stage_mm.expect("lit");
    assert!((truth[0] - mean_mm).abs() < 1e-9 && truth[1] == 0.0, "{truth:?} {mean_mm}");

    // Profile across the right edge of the −1 view, mean over rows well inside.
    let offset = config.camera.offset_dn;
    let profile = |frame: &SimFrame| -> Vec<f64> {
        let rows = 90..150;
        (0..frame.width / 2)
            .map(|x| {
                rows.clone().map(|y| f64::from(frame.data[y * frame.width + x]) - offset).sum::<f64>()
                    / rows.len() as f64
            })
            .collect()
    };
    let (sharp, blurred) = (profile(&frames[0]), profile(&frames[1]));
    let flat = |p: &[f64]| p[60..80].iter().sum::<f64>() / 20.0;
    // Area under the normalised profile is where the edge is, on average over the light.
    let edge = |p: &[f64]| p.iter().sum::<f64>() / flat(p);
    // Magnification of the −1 view near its right edge, from the tracer.
    let scene = daic_hil_sim::scene::Scene::new(&config).expect("scene");
    let at = |x: f64| {
        scene.object_point(daic_hil_sim::scene::trace::View::Minus, x, 120.0, [0.0; 3]).expect("seen")[0]
    };
    let mm_per_px = (at(102.0) - at(100.0)) / 2.0;
    // The sharp edge is known to the spacing of the sample points, 0.2 px.
    assert!((at(edge(&sharp) - 0.7) - 10.0).abs() < 0.2 * mm_per_px);
    // The smeared one averages over 54 places; column 0 begins at −½. Measured 4.2 µm,
    // 0.02 px: what is left of the sample points' spacing.
    let moved = at(edge(&blurred) - 0.5) - 10.0;
    assert!((moved - mean_mm).abs() < 6e-3, "{moved} {mean_mm}");
    // The ramp's width by the second moment of the edge: light over time gives the variance of the
    // position, computed from the pulses.
    let spread = |p: &[f64]| {
        let (mut weight, mut first, mut second) = (0.0, 0.0, 0.0);
        for x in 80..p.len() - 1 {
            let (d, at) = ((p[x] - p[x + 1]) / flat(p), x as f64 + 0.5);
            weight += d;
            first += d * at;
            second += d * at * at;
        }
        second / weight - (first / weight).powi(2)
    };
    let mut times = vec![on];
    times.extend(&rises);
    times.push(off);
    let (mut first, mut second) = (0.0, 0.0);
    for (k, pair) in times.windows(2).enumerate() {
        let (weight, at) = ((pair[1] - pair[0]) as f64 / (off - on) as f64, k as f64 / 6400.0);
        first += weight * at;
        second += weight * at * at;
    }
    let expected = (second - first * first).sqrt();
    // Two neighbouring pixels see an edge through a triangle of variance 1/6.
    let measured = (spread(&blurred) - 1.0 / 6.0).sqrt() * mm_per_px;
    println!("moved {moved} {mean_mm}, spread {measured} {expected}");
    assert!((measured / expected - 1.0).abs() < 0.01, "{measured} {expected}");
}

#[test]
fn frames_are_dropped_and_doubled_on_demand() {
    let mut config = small();
    config.faults.drop_frames = vec![1];
    config.faults.duplicate_frames = vec![2];
    let one = strobed(100, 50);
    let (_, frames) = frames(config, &program(&[&level(u16::MAX), &one, &one, &one, &one]));
    assert_eq!(frames.iter().map(|f| f.id).collect::<Vec<_>>(), [0, 2, 2, 3]);
    assert_eq!(frames[1], frames[2]);
}

#[test]
fn exposure_set_before_a_start_holds_for_it() {
    let rig = SimRig::start(noiseless(small()), Transport::InProcess).expect("starts");
    let mut host = host(&rig);
    for us in [50u64, 1000] {
        rig.set_exposure(us * 1000);
        host.run(&program(&[&level(u16::MAX), &strobed(20, 100)]));
        let truth = rig.next_frame(Duration::from_secs(20)).expect("frame").truth;
        assert_eq!(truth.exposure_end_tick - truth.exposure_start_tick, us * u64::from(US));
    }
}

#[test]
fn reset_and_silence_on_demand() {
    let mut config = small();
    config.faults.reset_after_requests = Some(3);
    let rig = SimRig::start(config, Transport::InProcess).expect("starts");
    let mut host1 = host(&rig);
    let first = host1.boot_id();
    host1.status();
    host1.status();
    assert_eq!(host1.try_request(&daic_protocol::message::Request::Status), None);
    assert_ne!(host1.boot_id(), first);
    assert!(host1.status().tick < 1_000_000, "ticks count from the boot");
    assert_eq!(rig.truth().boots, 2);
    rig.set_silent(true);
    assert_eq!(host1.try_request(&daic_protocol::message::Request::Status), None);
    rig.set_silent(false);
    host1.status();
    drop(rig);

    let mut config = small();
    config.faults.silent_after_requests = Some(1);
    let rig = SimRig::start(config, Transport::InProcess).expect("starts");
    let mut host2 = host(&rig);
    host2.status();
    assert_eq!(host2.try_request(&daic_protocol::message::Request::Status), None);
}

/// A reset leaves the stage where it is, though the box has forgotten it.
#[test]
fn reset_turns_outputs_off_and_leaves_the_stage() {
    let rig = SimRig::start(small(), Transport::InProcess).expect("starts");
    let mut host = host(&rig);
    host.run(&[go(0, 640)]);
    rig.reset_board();
    while rig.truth().boots < 2 {
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(host.status().position[0], 0);
    assert_eq!(rig.truth().stage_mm[0], 0.1);
    assert_eq!(rig.played().last().map(|w| w.1), Some(0));
}
