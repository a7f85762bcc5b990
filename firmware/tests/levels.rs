//! LED levels: the bytes and duty cycles that the drivers put out, against what the chips' data sheets say.

use core::convert::Infallible;
use daic_firmware::levels::{Chain, LevelDriver, Mcp4728, Mcp4922, Pwm};
use embedded_hal::i2c::{self, ErrorKind, I2c, Operation as I2cOperation};
use embedded_hal::pwm::{ErrorType as PwmError, SetDutyCycle};
use embedded_hal::spi::{ErrorType as SpiError, Operation as SpiOperation, SpiDevice};

/// An I²C bus that keeps what is written, or does not answer.
#[derive(Default)]
struct Bus {
    written: Vec<(u8, Vec<u8>)>,
    is_deaf: bool,
}

#[derive(Debug, PartialEq)]
struct NoAnswer;

impl i2c::Error for NoAnswer {
    fn kind(&self) -> ErrorKind {
        ErrorKind::NoAcknowledge(i2c::NoAcknowledgeSource::Address)
    }
}

impl i2c::ErrorType for Bus {
    type Error = NoAnswer;
}

impl I2c for Bus {
    fn transaction(&mut self, address: u8, operations: &mut [I2cOperation<'_>]) -> Result<(), NoAnswer> {
        if self.is_deaf {
            return Err(NoAnswer);
        }
        for operation in operations {
            match operation {
                I2cOperation::Write(bytes) => self.written.push((address, bytes.to_vec())),
                I2cOperation::Read(_) => panic!("nothing is read"),
            }
        }
        Ok(())
    }
}

/// An SPI device that keeps what is written while it is selected.
#[derive(Default)]
struct Device(Vec<Vec<u8>>);

impl SpiError for Device {
    type Error = Infallible;
}

impl SpiDevice for Device {
    fn transaction(&mut self, operations: &mut [SpiOperation<'_, u8>]) -> Result<(), Infallible> {
        let mut selected = Vec::new();
        for operation in operations {
            match operation {
                SpiOperation::Write(bytes) => selected.extend_from_slice(bytes),
                _ => panic!("only written"),
            }
        }
        self.0.push(selected);
        Ok(())
    }
}

/// A pin with so many steps of duty cycle.
struct Pin {
    top: u16,
    duty: Option<u16>,
}

impl PwmError for Pin {
    type Error = Infallible;
}

impl SetDutyCycle for Pin {
    fn max_duty_cycle(&self) -> u16 {
        self.top
    }
    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        assert!(duty <= self.top);
        self.duty = Some(duty);
        Ok(())
    }
}

/// ⌊level · 4095 / 65 535⌋, by counting.
fn twelve_bits(level: u16) -> u16 {
    (0..=4095u64).take_while(|v| v * 65_535 <= u64::from(level) * 4095).last().unwrap() as u16
}

/// MCP4728 data sheet (Microchip DS22187E), figure 5-8, "Multi-Write": device code 1100 and three address bits;
/// second byte 0 1 0 0 0 DAC1 DAC0 UDAC̄; third V_REF PD1 PD0 G_X D11 … D8; fourth D7 … D0.
#[test]
fn mcp4728_multi_write() {
    let mut bus = Bus::default();
    let mut driver = Mcp4728::new(&mut bus, 0x60);
    let levels = [0u16, 1, 15, 16, 17, 0x1234, 0x8000, 0xfffe, 0xffff];
    for channel in 0..4 {
        for level in levels {
            driver.set(channel, level).unwrap();
        }
    }
    // Beyond the last channel nothing is written.
    driver.set(4, 0xffff).unwrap();
    assert_eq!(bus.written.len(), 4 * levels.len());
    for (index, (address, bytes)) in bus.written.iter().enumerate() {
        let (channel, level) = ((index / levels.len()) as u8, levels[index % levels.len()]);
        assert_eq!((*address, bytes.len()), (0x60, 3));
        assert_eq!(bytes[0] >> 3, 0b01000, "multi-write");
        assert_eq!((bytes[0] >> 1) & 3, channel);
        assert_eq!(bytes[0] & 1, 0, "output updated at once");
        assert_eq!(bytes[1] >> 4, 0, "supply as reference, powered, gain 1");
        let value = u16::from(bytes[1] & 0xf) << 8 | u16::from(bytes[2]);
        assert_eq!(value, twelve_bits(level), "{level}");
    }
}

#[test]
fn a_bus_that_does_not_answer_is_told() {
    let mut driver = Mcp4728::new(Bus { is_deaf: true, ..Bus::default() }, 0x60);
    assert_eq!(driver.set(0, 1), Err(NoAnswer));
}

/// MCP4922 data sheet (Microchip DS22250A), register 5-1: Ā/B, BUF, G̅A̅, S̅H̅D̅N̅, D11 … D0, 16 bits in one
/// selection, most significant first.
#[test]
fn mcp4922_register() {
    let mut driver = Mcp4922(Device::default());
    for (channel, level) in [(0u8, 0u16), (0, 0xffff), (1, 0x8000), (1, 0x0fff), (0, 16)] {
        driver.set(channel, level).unwrap();
        let sent = driver.0.0.last().unwrap();
        assert_eq!(sent.len(), 2);
        let word = u16::from(sent[0]) << 8 | u16::from(sent[1]);
        assert_eq!(word >> 15, u16::from(channel));
        assert_eq!((word >> 12) & 7, 0b011, "unbuffered, gain 1, on");
        assert_eq!(word & 0xfff, twelve_bits(level));
    }
    let before = driver.0.0.len();
    driver.set(2, 0xffff).unwrap();
    assert_eq!(driver.0.0.len(), before, "there is no channel 2");
}

/// Never more than asked for, nothing at 0, all at full scale, whatever the pin can do.
#[test]
fn pwm_rounds_down() {
    for top in [1u16, 2, 255, 1000, 62_499, 65_534, 65_535] {
        let mut pwm = Pwm([Pin { top, duty: None }, Pin { top, duty: None }]);
        for level in (0..=65_535u16).step_by(257).chain([1, 2, 65_534]) {
            pwm.set(1, level).unwrap();
            let duty = pwm.0[1].duty.unwrap();
            // duty / top ≤ level / 65 535 < (duty + 1) / top
            let (d, t, l) = (u64::from(duty), u64::from(top), u64::from(level));
            assert!(d * 65_535 <= l * t && (d + 1) * 65_535 > l * t, "{level} of {top}: {duty}");
        }
        pwm.set(1, 0).unwrap();
        assert_eq!(pwm.0[1].duty, Some(0));
        pwm.set(1, 65_535).unwrap();
        assert_eq!((pwm.0[1].duty, pwm.0[0].duty), (Some(top), None));
        // No such pin.
        pwm.set(2, 1).unwrap();
    }
}

#[test]
fn two_drivers_in_a_chain() {
    let pins = Pwm([Pin { top: 100, duty: None }, Pin { top: 100, duty: None }]);
    let mut chain = Chain::<_, _, 2>(pins, Mcp4922(Device::default()));
    for channel in 0..4 {
        chain.set(channel, 0xffff).unwrap();
    }
    assert_eq!(chain.0.0.iter().map(|p| p.duty).collect::<Vec<_>>(), [Some(100), Some(100)]);
    assert_eq!(chain.1.0.0, [[0x3f, 0xff], [0xbf, 0xff]]);
}
