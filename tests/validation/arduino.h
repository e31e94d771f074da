// Just enough of the Arduino library to run MM-Ard's published firmware on Linux: the serial port is a terminal, what
// leaves the board goes to stderr ("TTL 5", "DAC A 4095"), every analogue pin p reads 1000 - 100 p.
#include <poll.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>

typedef uint8_t byte;
typedef bool boolean;

enum { LOW, HIGH, INPUT, OUTPUT, MSBFIRST };
enum { B00000000 = 0, B00001111 = 0x0f, B00111111 = 0x3f, B10000000 = 0x80, B11000000 = 0xc0 };

// macros, since the sketch has variables of these names
#define highByte(value) ((uint8_t)((value) >> 8))
#define lowByte(value) ((uint8_t)(value))

static uint8_t PIND, PINC, PORTC, DDRC;

struct TtlPort {
    uint8_t value = 0;
    TtlPort& operator=(uint8_t next) {
        if (next != value) fprintf(stderr, "TTL %d\n", next);
        value = next;
        return *this;
    }
    operator uint8_t() const { return value; }
} static PORTB;

static unsigned shifted, bits;

inline void pinMode(int, int) {}
inline int digitalRead(int) { return LOW; }
inline int analogRead(int pin) { return 1000 - 100 * pin; }
inline void delay(unsigned) {}

inline void shiftOut(int, int, int, uint8_t value) {
    shifted = shifted << 8 | value;
    bits += 8;
}

// The TLV5618's chip select is pin 5: a word of 16 bits is taken when it rises; bit 15 chooses the channel.
inline void digitalWrite(int pin, int level) {
    if (pin != 5) return;
    if (level == HIGH && bits == 16) fprintf(stderr, "DAC %c %u\n", shifted & 0x8000 ? 'A' : 'B', shifted & 0xfff);
    shifted = bits = 0;
}

inline unsigned long millis() {
    timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec % 1000000 * 1000 + now.tv_nsec / 1000000;
}

struct SerialPort {
    int terminal;
    void begin(long) {}
    int available() {
        pollfd wait{terminal, POLLIN, 0};
        return poll(&wait, 1, 1) > 0 && wait.revents & POLLIN;
    }
    int read() {
        uint8_t value;
        if (::read(terminal, &value, 1) != 1) exit(0);
        return value;
    }
    void send(const void* data, size_t size) {
        if (::write(terminal, data, size) != (ssize_t)size) exit(1);
    }
    template <class Integer>
    void write(Integer value) {
        uint8_t low = value;
        send(&low, 1);
    }
    void write(const char* text) { send(text, strlen(text)); }
    void println(const char* text) {
        write(text);
        write("\r\n");
    }
    void println(unsigned value) {
        char text[16];
        snprintf(text, sizeof text, "%u", value);
        println(text);
    }
} static Serial;

bool waitForSerial(unsigned long);
void analogueOut(int, byte, byte);
void setup();
void loop();

int main(int, char** arguments) {
    setvbuf(stderr, nullptr, _IOLBF, 0);
    Serial.terminal = atoi(arguments[1]);
    setup();
    for (;;) loop();
}
