//! LED levels by PWM and by external converters, through embedded-hal.
//!
//! Every driver takes levels from 0 to 65 535 (full scale) and rounds down to what it can do, so that an LED
//! never gets more than asked for.

use embedded_hal::i2c::I2c;
use embedded_hal::pwm::SetDutyCycle;
use embedded_hal::spi::SpiDevice;

/// Sets the level of LEDs.
pub trait LevelDriver {
    /// Why a level could not be set.
    type Error;
    /// Sets channel `channel` to `level` of 65 535.
    ///
    /// # Errors
    /// Those of the bus or the pin. The level may then be the old one or the new one.
    fn set(&mut self, channel: u8, level: u16) -> Result<(), Self::Error>;
}

/// ⌊level · top / 65 535⌋.
fn scale(level: u16, top: u16) -> u16 {
    let product = u32::from(level).saturating_mul(u32::from(top));
    u16::try_from(product / 0xffff).unwrap_or(top)
}

/// One PWM output per LED.
#[derive(Debug)]
pub struct Pwm<P, const N: usize>(pub [P; N]);

impl<P: SetDutyCycle, const N: usize> LevelDriver for Pwm<P, N> {
    type Error = P::Error;
    fn set(&mut self, channel: u8, level: u16) -> Result<(), P::Error> {
        match self.0.get_mut(usize::from(channel)) {
            Some(pin) => {
                let top = pin.max_duty_cycle();
                pin.set_duty_cycle(scale(level, top))
            }
            None => Ok(()),
        }
    }
}

/// Microchip MCP4728: four channels of 12 bits on I²C. Uses "multi-write", which changes the
/// output at once and not the EEPROM, with the supply as reference.
#[derive(Debug)]
pub struct Mcp4728<B> {
    bus: B,
    address: u8,
}

impl<B: I2c> Mcp4728<B> {
    /// On `bus` at `address` (0x60 from the factory).
    pub fn new(bus: B, address: u8) -> Self {
        Self { bus, address }
    }
}

impl<B: I2c> LevelDriver for Mcp4728<B> {
    type Error = B::Error;
    fn set(&mut self, channel: u8, level: u16) -> Result<(), B::Error> {
        if channel > 3 {
            return Ok(());
        }
        let [high, low] = scale(level, 4095).to_be_bytes();
        // C2 C1 C0 W1 W0 = 01000, channel, UDAC = 0; VREF = 0, PD = 00, gain = 0, value.
        self.bus.write(self.address, &[0x40 | (channel << 1), high, low])
    }
}

/// Microchip MCP4922: two channels of 12 bits on SPI (mode 0), unbuffered reference, gain 1.
#[derive(Debug)]
pub struct Mcp4922<D>(pub D);

impl<D: SpiDevice> LevelDriver for Mcp4922<D> {
    type Error = D::Error;
    fn set(&mut self, channel: u8, level: u16) -> Result<(), D::Error> {
        if channel > 1 {
            return Ok(());
        }
        // A/B, BUF = 0, GA = 1 (gain 1), SHDN = 1 (on), value.
        let [high, low] = scale(level, 4095).to_be_bytes();
        self.0.write(&[(channel << 7) | 0x30 | high, low])
    }
}

/// Two drivers, the second one for channels from `N` on.
#[derive(Debug)]
pub struct Chain<A, B, const N: u8>(pub A, pub B);

/// The error of either of two drivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Either<A, B> {
    /// Of the first.
    First(A),
    /// Of the second.
    Second(B),
}

impl<A: LevelDriver, B: LevelDriver, const N: u8> LevelDriver for Chain<A, B, N> {
    type Error = Either<A::Error, B::Error>;
    fn set(&mut self, channel: u8, level: u16) -> Result<(), Self::Error> {
        match channel.checked_sub(N) {
            None => self.0.set(channel, level).map_err(Either::First),
            Some(channel) => self.1.set(channel, level).map_err(Either::Second),
        }
    }
}
