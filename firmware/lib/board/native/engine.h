/* The production node on a PC, as a C library: what the emulator loads. No globals: any number of
 * nodes in one process; one node's functions are not to be called from two threads at once. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct relpos_node relpos_node;

typedef struct {
  void* context; /* handed back in every call */
  /* S address+W first [Sr address+W second] [Sr address+R read] P: first, and second behind it, are
   * in wire; what is read is put there. One buffer, as following pointers costs Python much time.
   * Returns 0 ok, 1 address nack, 2 data nack, 3 timeout or bus stuck. */
  uint8_t (*i2c_transfer)(void* context, uint8_t address, uint8_t first_count,
                          uint8_t second_count, uint8_t read_count);
  uint8_t* wire; /* 510 bytes, the caller's; they must outlive the node */
  /* Bytes leaving the node, at the end of a poll; the line's speed is the caller's to model. */
  void (*uart_write)(void* context, const uint8_t* bytes, uint16_t count);
  /* The node asked to reboot: destroy it after the poll has returned and create it anew with reset
   * cause 5 (command). */
  void (*reset)(void* context);
  /* A byte begins to be written to eeprom, which is the caller's to do; NULL: written in place. For
   * 3.4 ms the node gets no further one written. What already stands there is not written again. */
  void (*storage_write)(void* context, uint16_t at, uint8_t value);
} relpos_board_callbacks;

/* eeprom (at least 250 bytes, 0xFF where never written) stays the caller's and is written in place;
 * it must outlive the node. node_id 0: the one in the EEPROM. reset_cause is the wire's ResetCause.
 * NULL where callbacks, EEPROM or its size will not do. */
relpos_node* relpos_node_create(const relpos_board_callbacks* callbacks, uint8_t* eeprom,
                                uint16_t eeprom_size, uint8_t node_id, uint8_t reset_cause,
                                uint32_t now_us);
void relpos_node_destroy(relpos_node* node);
/* Bytes that arrive at the node's UART; up to 256 wait for the next poll, more are lost, as on the
 * boards. */
void relpos_node_receive(relpos_node* node, const uint8_t* bytes, uint16_t count);
/* What the board's supply is from now on; 5000 from the start. */
void relpos_node_set_supply(relpos_node* node, uint16_t supply_mv);
/* One pass of the main loop. Returns microseconds until it wants the next one; 0: at once. */
uint32_t relpos_node_poll(relpos_node* node, uint32_t now_us);

#ifdef __cplusplus
}
#endif
