"""Policies in integers and in floats on small machines: AVR, Cortex-M0 and M4, RISC-V, run under Debian's emulators.

simavr counts the cycles of an ATmega1284P. QEMU has no cycles: under ``-icount shift=6`` every instruction takes
64 ns, so of the other machines instructions are reported. Bytes are what a policy adds to a linked program, with the
functions of the compiler's and the mathematical library that it calls. Compilers and emulators are Debian's packages.
"""

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr

_STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]
_MULTIPLIER, _INCREMENT, _PRIME = 1664525, 1013904223, 16777619
# States from a generator of 32 bits, which Python repeats; answers are hashed. Each call is timed by itself.
_DRIVER = """
#include <stdint.h>

{declared}
void put(const char *text);
uint32_t now(void);
void begin(void);
void finish(void);

static const int32_t low[{d}] = {{ {low} }};
static const uint32_t span[{d}] = {{ {span} }};
{scales}

static void put_number(uint32_t number)
{{
    char text[12];
    int at = 11;
    text[at] = 0;
    text[--at] = '\\n';
    do {{
        text[--at] = (char)('0' + number % 10);
        number /= 10;
    }} while (number);
    put(text + at);
}}

int main(void)
{{
    uint32_t state = 1, hash = 2166136261u, total = 0, most = 0, empty, n;
    {x_type} x[{d}];
    {y_type} y[{o}];
    int k;
    begin();
    empty = now();
    empty = now() - empty;
    for (n = 0; n < {n}; n++) {{
        uint32_t spent;
        for (k = 0; k < {d}; k++) {{
            state = state * {multiplier}u + {increment}u;
            x[k] = ({x_type})(low[k] + (int32_t)(((uint64_t)state * span[k]) >> 32)){scaled};
        }}
        spent = now();
        {call}
        spent = now() - spent - empty;
        total += spent;
        most = spent > most ? spent : most;
        for (k = 0; k < {o}; k++)
            hash = (hash ^ (uint32_t)(int32_t)y[k]) * {prime}u;
    }}
    put_number(hash);
    put_number(total / {n});
    put_number(most);
    finish();
    return 0;
}}
"""
_AVR = """
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <stdint.h>
static volatile uint16_t overflows;
ISR(TIMER1_OVF_vect) { overflows++; }
void begin(void) { TCCR1B = 1; TIMSK1 = 1; UCSR0B = 8; sei(); }
uint32_t now(void)
{
    uint16_t high, low;
    cli();
    low = TCNT1;
    high = overflows;
    if ((TIFR1 & 1) && low < 32768)
        high++;
    sei();
    return ((uint32_t)high << 16) | low;
}
void put(const char *text)
{
    for (; *text; text++) {
        while (!(UCSR0A & 32))
            ;
        UDR0 = (uint8_t)*text;
    }
}
void finish(void) { cli(); sleep_enable(); sleep_cpu(); }
"""
_SEMIHOSTING = """
#include <stddef.h>
#include <stdint.h>
static long call(long what, void *with)
{
    register long a __asm__("%(a)s") = what;
    register void *b __asm__("%(b)s") = with;
    __asm__ volatile("%(trap)s" : "+r"(a) : "r"(b) : "memory");
    return a;
}
void put(const char *text) { call(4, (void *)text); }
void finish(void) { call(0x18, (void *)0x20026); for (;;) ; }
void *memcpy(void *to, const void *from, size_t n)
{
    char *t = to;
    const char *f = from;
    while (n--)
        *t++ = *f++;
    return to;
}
void *memset(void *to, int value, size_t n)
{
    char *t = to;
    while (n--)
        *t++ = (char)value;
    return to;
}
int main(void);
extern char stack_top[], data_from[], data_start[], data_end[], bss_start[], bss_end[];
void reset(void)
{
    memcpy(data_start, data_from, (size_t)(data_end - data_start));
    memset(bss_start, 0, (size_t)(bss_end - bss_start));
    main();
}
"""
_ARM = (
    _SEMIHOSTING % {"a": "r0", "b": "r1", "trap": "bkpt 0xab"}
    + """
#define TIMER ((volatile uint32_t *)0xe000e010)  /* SysTick, which counts 24 bits down */
static uint32_t last, passed;
void begin(void) { TIMER[1] = 0xffffff; TIMER[2] = 0; TIMER[0] = 5; last = TIMER[2]; }
uint32_t now(void)
{
    const uint32_t at = TIMER[2];
    passed += (last - at) & 0xffffff;
    last = at;
    return passed;
}
__attribute__((section(".start"), used)) void *const vectors[16] = {stack_top, (void *)reset};
"""
)
_RISCV = (
    _SEMIHOSTING
    % {"a": "a0", "b": "a1", "trap": ".option push\\n.option norvc\\n.balign 16\\n"
       "slli x0, x0, 0x1f\\nebreak\\nsrai x0, x0, 7\\n.option pop"}
    + """
void begin(void) {}
uint32_t now(void) { uint32_t n; __asm__ volatile("csrr %0, minstret" : "=r"(n)); return n; }
__attribute__((section(".start"), naked, used)) void start(void) { __asm__("la sp, stack_top\\n call reset"); }
"""
)  # fmt: skip
_LINKED = """
MEMORY {{ flash : ORIGIN = {flash}, LENGTH = 256K  ram : ORIGIN = {ram}, LENGTH = 16K }}
ENTRY({entry})
SECTIONS {{
    .text : {{ KEEP(*(.start)) *(.text*) *(.rodata*) *(.srodata*) }} > flash
    data_from = LOADADDR(.data);
    .data : {{ data_start = .; *(.data*) *(.sdata*) . = ALIGN(4); data_end = .; }} > ram AT> flash
    .bss : {{ bss_start = .; *(.bss*) *(.sbss*) *(COMMON) . = ALIGN(4); bss_end = .; }} > ram
    stack_top = ORIGIN(ram) + LENGTH(ram);
}}
"""


@dataclass(frozen=True)
class Target:
    """A machine: how code is compiled for it, and the emulator that runs it."""

    prefix: str  # of the compiler's commands
    flags: tuple[str, ...]
    emulator: tuple[str, ...]
    support: str  # C that starts a program, prints and counts
    packages: str  # of Debian
    linked: str | None = None  # the linker's script
    unit: str = "instructions"
    tick: float = 1.0  # of the clock that a program reads, in that unit

    def missing(self) -> str | None:
        """Return a command that is not there; None if all are."""
        needed = (f"{self.prefix}gcc", self.emulator[0])
        return next((command for command in needed if shutil.which(command) is None), None)


def _qemu(system: str, machine: str) -> tuple[str, ...]:
    return (f"qemu-system-{system}", "-M", machine, "-display", "none", "-serial", "null", "-monitor", "none",
            "-icount", "shift=6", "-semihosting-config", "enable=on,target=native", "-kernel")  # fmt: skip


_ARM_SCRIPT = _LINKED.format(flash="0x0", ram="0x20000000", entry="reset")
_ARM_PACKAGES = "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
TARGETS = {
    "AVR": Target("avr-", ("-mmcu=atmega1284p",), ("simavr", "-m", "atmega1284p", "-f", "16000000"), _AVR,
                  "gcc-avr avr-libc simavr", unit="cycles"),
    "Cortex-M0": Target("arm-none-eabi-", ("-mcpu=cortex-m0", "-mthumb"), _qemu("arm", "microbit"), _ARM,
                        _ARM_PACKAGES, _ARM_SCRIPT, tick=62.5 / 64),
    "Cortex-M4": Target("arm-none-eabi-", ("-mcpu=cortex-m4", "-mthumb"), _qemu("arm", "mps2-an386"), _ARM,
                        _ARM_PACKAGES, _ARM_SCRIPT, tick=40 / 64),
    "RISC-V": Target("riscv64-unknown-elf-", ("-march=rv32imac", "-misa-spec=2.2", "-mabi=ilp32", "-ffreestanding"),
                     (*_qemu("riscv32", "virt")[:-1], "-bios", "none", "-kernel"), _RISCV,
                     "gcc-riscv64-unknown-elf qemu-system-misc",
                     _LINKED.format(flash="0x80000000", ram="0x80100000", entry="start"),
                     tick=1 / 64),
}  # fmt: skip


@dataclass(frozen=True)
class Ran:
    """What a machine gave: the hash of all answers, what a call takes (cycles or instructions), bytes of the policy."""

    hash: int
    mean: int
    most: int
    n_bytes: int


@dataclass(frozen=True)
class Source:
    """C of others, which declares ``void policy(const float x[d], float y[o])``, and where its headers are."""

    text: str
    headers: str


def states(fixed: otr.FixedPointTree, n: int) -> np.ndarray:
    """Return the states (n, d) of the driver."""
    low, span = fixed.input_low.tolist(), (fixed.input_high - fixed.input_low + 1).tolist()
    state, rows = 1, []
    for _ in range(n):
        row = []
        for least, width in zip(low, span, strict=True):
            state = (state * _MULTIPLIER + _INCREMENT) % 2**32
            row.append(least + (state * width >> 32))
        rows.append(row)
    return np.array(rows)


def answers_hash(fixed: otr.FixedPointTree, n: int) -> int:
    """Return the hash of the answers in Python."""
    found = 2166136261
    for answer in fixed.predict_integers(states(fixed, n)).reshape(-1).tolist():
        found = (found ^ answer % 2**32) * _PRIME % 2**32
    return found


def run_on(target: Target, fixed: otr.FixedPointTree, n: int, folder: Path, in_floats: Any = None) -> Ran:
    """Return what a machine does with a fixed-point tree or, on the same states, a policy `in_floats`, n times.

    That is a policy of `otr.to_c`, or a `Source`.
    """
    flags = _STRICT
    if isinstance(in_floats, Source):
        source, flags = in_floats.text, ["-w", "-I", in_floats.headers]
    else:
        source = otr.to_c(fixed) if in_floats is None else otr.to_c(in_floats, dtype="float")
    labelled = "policy_label(" in source
    (declared,) = re.findall(r"^(\w.* policy(?:_label)?\(.*\));", source, re.M)
    n_answers = 1 if labelled else int(re.search(r" y\[(\d+)\]", declared)[1])  # type: ignore[index]
    x_type = re.search(r"const (\w+) x", declared)[1]  # type: ignore[index]
    y_type = "int32_t" if labelled else re.search(r"(\w+) y\[", declared)[1]  # type: ignore[index]
    scales = ", ".join(f"{float(scale):.9g}f" for scale in fixed.input_scales)
    driver = _DRIVER.format(
        declared=f"{declared};",
        d=fixed.n_inputs,
        o=n_answers,
        n=n,
        low=", ".join(map(str, fixed.input_low.tolist())),
        span=", ".join(map(str, (fixed.input_high - fixed.input_low + 1).tolist())),
        scales="" if in_floats is None else f"static const float scale[{fixed.n_inputs}] = {{ {scales} }};",
        scaled="" if in_floats is None else " * scale[k]",
        x_type=x_type,
        y_type=y_type,
        call="y[0] = policy_label(x);" if labelled else "policy(x, y);",
        multiplier=_MULTIPLIER,
        increment=_INCREMENT,
        prime=_PRIME,
    )
    stub = f"#include <stdint.h>\n{declared} {{ (void)x; {'return 0;' if labelled else 'y[0] = 0;'} }}\n"
    sizes = [_size(target, _linked(target, text, driver, folder, flags)) for text in (stub, source)]
    program = folder / "program.elf"
    done = subprocess.run([*target.emulator, str(program)], capture_output=True, text=True, timeout=600, check=False)
    printed = re.sub(r"\x1b\[[\d;]*m", "", done.stdout + done.stderr)
    found = re.findall(r"^(\d+)\.?\s*$", printed, re.M)  # simavr shows a line's end as a dot
    if len(found) != 3:
        raise RuntimeError(f"{' '.join(target.emulator)} printed {printed[-1000:]}")
    mean, most = (round(int(ticks) * target.tick) for ticks in found[1:])
    return Ran(int(found[0]), mean, most, sizes[1] - sizes[0])


def _linked(target: Target, source: str, driver: str, folder: Path, flags: list[str]) -> Path:
    """Return a program, whose policy is compiled with some flags."""
    objects = []
    for name, text, more in (("policy", source, flags), ("driver", driver, []), ("support", target.support, [])):
        path = folder / f"{name}.c"
        path.write_text(text)
        command = [f"{target.prefix}gcc", *target.flags, *more, "-Os", "-ffunction-sections", "-fdata-sections", "-c"]
        _run([*command, str(path), "-o", str(path.with_suffix(".o"))])
        objects.append(str(path.with_suffix(".o")))
    program = folder / "program.elf"
    link = [f"{target.prefix}gcc", *target.flags, *objects, "-Wl,--gc-sections", "-o", str(program)]
    if target.linked is not None:
        (folder / "linked.ld").write_text(target.linked)
        link += ["-nostartfiles", "-nostdlib", "-T", str(folder / "linked.ld")]
        link += ["-lgcc"] if "-ffreestanding" in target.flags else ["-lm", "-lc", "-lgcc", "-lnosys"]
    else:
        link += ["-lm"]
    _run(link)
    return program


def _size(target: Target, program: Path) -> int:
    """Return the bytes that a program takes in flash."""
    return sum(map(int, _run([f"{target.prefix}size", str(program)]).splitlines()[1].split()[:2]))


def _run(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:2])} ... failed with {done.returncode}:\n{done.stderr}")
    return done.stdout
