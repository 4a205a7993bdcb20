// A firmware of a few lines for the tests of the native engine: it reports over its UART what the
// engine did to it. 'P' and its clock at each poll, 'R' and what it received, 'B' and its reset
// cause and first EEPROM byte at the start, 'I' and the outcome of a read of the byte at 0x50/3.
// Received 'X' makes it ask for a reset, 'W' n writes n into the EEPROM, 'H' makes it want to run
// at once, 'T' reads the bus.
#include "board/native/engine.h"

#include <stdlib.h>

struct relpos_node {
  relpos_board_callbacks board;
  uint8_t* eeprom;
  uint8_t cause;
  uint8_t inbox[64];
  uint16_t count;
  bool announced, hasty;
};

extern "C" {

relpos_node* relpos_node_create(const relpos_board_callbacks* board, uint8_t* eeprom, uint16_t size,
                                uint8_t node_id, uint8_t reset_cause, uint32_t) {
  if (node_id == 99 || size < 192) return nullptr;
  relpos_node* node = static_cast<relpos_node*>(calloc(1, sizeof(relpos_node)));
  node->board = *board;
  node->eeprom = eeprom;
  node->cause = reset_cause;
  return node;
}

void relpos_node_destroy(relpos_node* node) { free(node); }

void relpos_node_receive(relpos_node* node, const uint8_t* bytes, uint16_t count) {
  for (uint16_t i = 0; i < count && node->count < sizeof node->inbox; ++i)
    node->inbox[node->count++] = bytes[i];
}

void relpos_node_set_supply(relpos_node*, uint16_t) {}

uint32_t relpos_node_poll(relpos_node* node, uint32_t now_us) {
  uint8_t out[80];
  uint16_t n = 0;
  if (!node->announced) {
    node->announced = true;
    out[n++] = 'B';
    out[n++] = node->cause;
    out[n++] = node->eeprom[0];
  }
  out[n++] = 'P';
  for (int i = 0; i < 4; ++i) out[n++] = static_cast<uint8_t>(now_us >> 8 * i);
  if (node->count) {
    out[n++] = 'R';
    out[n++] = node->inbox[0];
    if (node->inbox[0] == 'X') node->board.reset(node->board.context);
    if (node->inbox[0] == 'W') node->eeprom[0] = node->inbox[1];
    if (node->inbox[0] == 'H') node->hasty = true;
    if (node->inbox[0] == 'T') {
      out[n++] = 'I';
      node->board.wire[0] = 3;
      const uint8_t status = node->board.i2c_transfer(node->board.context, 0x50, 1, 0, 1);
      out[n++] = status;
      out[n++] = status ? 0 : node->board.wire[0];
    }
    node->count = 0;
  }
  node->board.uart_write(node->board.context, out, n);
  return node->hasty ? 0 : 10000;
}
}
