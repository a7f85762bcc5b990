"""The player's PIO programs in an independent emulator (PyPI rp2040-pio-emulator 0.88.0).

    python3 pio_check.py ../../firmware/boards/pico/src/player.rs ../../firmware/boards/pico/src/inputs.rs

That package has one machine, no background autopull and no STATUS source: the latter is added here, and
OUT refills at once, which for the player's program comes to the same.
"""

import random
import re
import sys
from collections import deque

import pioemu.instruction_decoder as decoder
from pioemu import ShiftRegister, State, emulate

STATUS_N = 2
original = decoder.InstructionDecoder.__init__


def with_status(self, *arguments, **keywords):
    original(self, *arguments, **keywords)
    self.mov_sources[5] = lambda state: 0xFFFFFFFF if len(state.transmit_fifo) < STATUS_N else 0


decoder.InstructionDecoder.__init__ = with_status


def programs(path):
    """The 32 words as the firmware loads them."""
    text = open(path).read()
    table = text[text.index("const PROGRAM"):]
    table = table[: table.index("];")]
    words = [0] * 32
    pairs = re.findall(r"\((\d+), 0x([0-9a-f]{4})\)", table)
    assert len(pairs) == 11, pairs
    for at, word in pairs:
        words[int(at)] = int(word, 16)
    return words


def play(words, fed, safe, cycles):
    """Pins in every cycle of machine 0 that is fed these words and no more."""
    waiting, fifo = deque(fed), deque()
    register = ShiftRegister(waiting.popleft(), 0) if waiting else ShiftRegister(0, 32)
    while waiting and len(fifo) < 8:
        fifo.append(waiting.popleft())
    state = State(program_counter=3, transmit_fifo=fifo, output_shift_register=register, y_register=safe, pin_values=safe)
    pins = []
    for _, after in emulate(
        words,
        stop_when=lambda _, s: s.clock >= cycles,
        initial_state=state,
        auto_pull=True,
        pull_threshold=32,
        wrap_target=31,
        wrap_top=31,
    ):
        pins.append(after.pin_values)
        while waiting and len(after.transmit_fifo) < 8:
            after.transmit_fifo.append(waiting.popleft())
    return pins


def player(words):
    rng, cuts, total = random.Random(7), 0, 0
    for _ in range(20):
        safe = rng.choice([0, rng.getrandbits(24)])
        records = [(rng.getrandbits(24), rng.choice([4, 4, 5, rng.randint(4, 40)])) for _ in range(15)]
        flat = [value for word, ticks in records for value in (word, ticks - 4)] + [safe, 0]
        for cut in range(len(flat) + 1):
            # A record is played if two more words wait behind it.
            played = [record for index, record in enumerate(records) if cut >= 2 * index + 3]
            expected = [safe] + [word for word, ticks in played for _ in range(ticks)]
            cycles = len(expected) + 60
            expected += [safe] * 60
            assert play(words, flat[:cut], safe, cycles) == expected, (cut, records)
            cuts, total = cuts + 1, total + cycles
    return f"player: {cuts} places where the words end, {total} cycles"


def interlock(words):
    """The wait itself, with the level at the package's pin 0."""
    for opened in range(3, 60):
        state = State(program_counter=4, y_register=0, pin_values=0b1011)

        def level(clock: int) -> int:
            return 1 if clock < opened else 0

        pins = [
            after.pin_values
            for _, after in emulate(
                words,
                stop_when=lambda _, s: s.clock >= 80,
                initial_state=state,
                input_source=level,
                wrap_target=5,
                wrap_top=5,
            )
        ]
        first = next(cycle for cycle, value in enumerate(pins) if value == 0)
        # The wait sees the level in its cycle, the write comes in the next (the package has no
        # synchroniser, which adds two).
        assert opened <= first <= opened + 1, (opened, first)
        assert all(value == 0 for value in pins[first:]), opened
    return "interlock: 57 instants, one cycle after the level, latched"


def heartbeat(words):
    for budget in [0, 1, 5, 100]:
        for feeds in [[], [10], [10, 40, 70]]:
            fifo = deque()
            state = State(program_counter=6, x_register=budget, y_register=0, pin_values=3, transmit_fifo=fifo)
            pins, fed = [], deque(feeds)
            for _, after in emulate(
                words, stop_when=lambda _, s: s.clock >= 1000, initial_state=state, wrap_target=9, wrap_top=9
            ):
                pins.append(after.pin_values)
                while fed and after.clock >= fed[0]:
                    fed.popleft()
                    after.transmit_fifo.append(budget)
            first = next(cycle for cycle, value in enumerate(pins) if value == 0)
            alive = [0] + [at for at in feeds if at <= 3 * budget + 6 or budget == 100]
            last = alive[-1] if budget == 100 else 0
            if budget == 100:
                assert last + 3 * budget <= first <= last + 3 * budget + 6, (budget, feeds, first)
            assert all(value == 0 for value in pins[first:]), "latched"
    return "heartbeat: 3 N to 3 N + 6 cycles after it was last fed, latched"


def stamping(path):
    """The program that stamps an input: what it counts is the time, whatever the pin does."""
    text = open(path).read()
    table = text[text.index("const PROGRAM"):]
    table = table[table.index("=") : table.index("];")]
    words = [int(word, 0) for word in re.findall(r"0x[0-9a-f]+|\b0\b", table)]
    assert len(words) == 13, words
    rng, changes = random.Random(9), 0
    for _ in range(200):
        at, edges = 0, []
        for _ in range(rng.randint(1, 8)):
            at += rng.choice([7, 8, 9, 10, 50, rng.randint(7, 400)])
            edges.append(at)

        def level(clock: int) -> int:
            return sum(edge <= clock for edge in edges) % 2

        state = State(x_register=0xFFFFFFFF, receive_fifo=deque())
        for _, last in emulate(
            words,
            stop_when=lambda _, s: s.clock >= at + 30,
            initial_state=state,
            input_source=level,
            jmp_pin=0,
            wrap_target=0,
            wrap_top=1,
        ):
            pass
        # The package's FIFO holds four.
        counts = list(last.receive_fifo)[:4]
        assert len(counts) == min(len(edges), 4), (edges, counts)
        for edge, count in zip(edges, counts):
            seen = 2 * (0xFFFFFFFF - count) - 1
            assert edge <= seen <= edge + 1, (edges, counts)
            changes += 1
    return f"stamping: {changes} changes, each seen within a cycle"


if __name__ == "__main__":
    words = programs(sys.argv[1])
    for check in (player, interlock, heartbeat):
        print(check(words))
    print(stamping(sys.argv[2]))
